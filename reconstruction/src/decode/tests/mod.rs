//! Tests of the decoder as a whole.

mod exact;
mod properties;
mod scenarios;
mod simulated;
