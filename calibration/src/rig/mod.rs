//! Both intrinsics, distortions and the pose between camera and projector, from views of a board.

mod adjust;
mod estimate;
mod homography;
mod initial;
mod model;
mod sample;
mod setup;

#[cfg(test)]
mod tests;
