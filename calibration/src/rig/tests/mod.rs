//! Rigs made here, with optics of their own: what is true is known without the code under test.

mod captured;
mod jacobian;
mod oracles;
mod refusals;
mod statistics;
pub(super) mod truth;
