//! Calibration boards: what they are, how they are printed, and where they are in an image.
