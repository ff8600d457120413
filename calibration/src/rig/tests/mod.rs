//! Rigs made here, with optics of their own: what is true is known without the code under test.

mod jacobian;
mod refusals;
mod statistics;
pub(super) mod truth;
