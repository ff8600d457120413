//! Tests of the decoder as a whole.

mod captures;
mod simulated;
pub(crate) mod synth;
