//! Tests of the decoder as a whole.

mod exact;
mod fast;
mod properties;
mod scenarios;
mod simulated;
