//! Both intrinsics, distortions and the pose between camera and projector, from views of a board.
