//! Entry point of the `polscan` program.

fn main() {}
