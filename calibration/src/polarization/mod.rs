//! Extinction, azimuth of the analyser, channels, drive levels and misregistration.
