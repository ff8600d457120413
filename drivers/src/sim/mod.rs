//! The simulated rig: a physically true twin of a scanner.
