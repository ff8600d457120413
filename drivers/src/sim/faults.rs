//! A list of what is wrong with a description, all of it at once.

/// Collects faults with their key paths.
#[derive(Debug)]
pub(crate) struct Faults {
    prefix: String,
    list: Vec<String>,
}

impl Faults {
    /// Key paths start with `prefix` (empty for none).
    pub(crate) fn new(prefix: &str) -> Self {
        Self { prefix: prefix.to_owned(), list: Vec::new() }
    }

    /// `key`: `problem`.
    pub(crate) fn add(&mut self, key: &str, problem: &str) {
        let dot = if self.prefix.is_empty() { "" } else { "." };
        self.list.push(format!("{}{dot}{key}: {problem}", self.prefix));
    }

    /// Refuses NaN and infinities.
    pub(crate) fn finite(&mut self, key: &str, value: f64) {
        if !value.is_finite() {
            self.add(key, &format!("is {value}, must be finite"));
        }
    }

    /// `value >= least`, finite.
    pub(crate) fn at_least(&mut self, key: &str, value: f64, least: f64) {
        if !(value.is_finite() && value >= least) {
            self.add(key, &format!("is {value}, must be at least {least}"));
        }
    }

    /// `value > bound`, finite.
    pub(crate) fn above(&mut self, key: &str, value: f64, bound: f64) {
        if !(value.is_finite() && value > bound) {
            self.add(key, &format!("is {value}, must be above {bound}"));
        }
    }

    /// `least <= value <= most`.
    pub(crate) fn within(&mut self, key: &str, value: f64, least: f64, most: f64) {
        if !(value >= least && value <= most) {
            self.add(key, &format!("is {value}, must be within {least} and {most}"));
        }
    }

    /// The faults in the order found.
    pub(crate) fn into_list(self) -> Vec<String> {
        self.list
    }
}
