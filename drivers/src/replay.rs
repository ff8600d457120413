//! The replay of a recorded scan as a camera.
