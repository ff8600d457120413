//! Photon transfer: gain, read noise, black level, linearity, saturation.
