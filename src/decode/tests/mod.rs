//! Tests of the decoder as a whole.

mod captures;
mod exact;
mod scenarios;
mod simulated;
pub(crate) mod synth;
