//! Progress of a scan on a terminal. Prints nothing where stderr is not one.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar over the frames of a scan and a line for what is being done.
pub struct Bar {
    bar: ProgressBar,
}

impl Bar {
    /// A bar for `frames` frames; hidden where stderr is not a terminal.
    pub fn new(frames: u64) -> Self {
        let bar = ProgressBar::with_draw_target(Some(frames), ProgressDrawTarget::stderr());
        let style = ProgressStyle::with_template("{msg:22} [{bar:40}] {pos:>2}/{len} {elapsed}")
            .expect("the template is a constant that indicatif accepts");
        bar.set_style(style.progress_chars("=> "));
        Self { bar }
    }

    /// Number of frames that there will be.
    pub fn length(&self, frames: u64) {
        self.bar.set_length(frames);
    }

    /// Number of frames that are done.
    pub fn frames(&self, done: u64) {
        self.bar.set_position(done);
    }

    /// What is being done now.
    pub fn say(&self, text: impl Into<std::borrow::Cow<'static, str>>) {
        self.bar.set_message(text);
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
