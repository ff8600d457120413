//! Tests of the decoder as a whole.

mod exact;
mod scenarios;
mod simulated;
