//! Tests of the decoder as a whole.

mod captures;
mod simulated;
mod synth;
