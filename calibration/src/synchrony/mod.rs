//! Output latency, rise and fall of the display, ripple of its lamp, and when it is safe to expose.
