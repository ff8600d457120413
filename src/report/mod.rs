//! What a person looks at.

pub mod colormap;
pub mod pictures;
