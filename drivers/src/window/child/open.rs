//! The open window: pictures, and the evidence of when each came to the glass.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use rustix::time::{ClockId, clock_gettime};
use winit::window::Window;

use super::{
    app::{Opening, written},
    gpu::Gpu,
    watch::{How, Seen, Watch},
};
use crate::{
    projector::{ReceiptMethod, Slide},
    window::{
        displays::{Display, Place},
        protocol::{Fault, Hello, Shown, VERSION, Want},
    },
};

/// Refresh of a display that does not tell its own.
const USUAL_HZ: f64 = 60.0;

/// Pictures to find out by what flips can be known. The first ones of a window may be copied where later ones flip.
const PROBES: usize = 4;

/// So many pictures in a row of which nothing was told: nothing will be.
const SILENT: usize = 2;

/// How long the first pictures are waited for.
const PROBE: Duration = Duration::from_millis(200);

/// Longest wait for a picture to come to the display; many refreshes, and a GPU that is a busy processor.
const SHOW: Duration = Duration::from_millis(1500);

/// How far the time of a completion may lie from now to be one of this clock.
const CLOCK_SLACK: Duration = Duration::from_secs(2);

/// By what a picture is known to be on its way.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Evidence {
    /// The Present extension completes it.
    Completion,
    /// The server draws it.
    Drawing,
    /// Only that the call returned.
    Return,
}

/// The open window.
pub(super) struct Open {
    want: Want,
    place: Place,
    window: Arc<Window>,
    id: u32,
    watch: Watch,
    /// `None` only after the GPU was lost.
    gpu: Option<Gpu>,
    slides: Vec<Slide>,
    evidence: Evidence,
    hello: Hello,
    pace: Pace,
    doubted: bool,
}

/// Refreshes of a display that does not tell them: a clock of our own, so that pictures do not come faster than a
/// display could show them.
struct Pace {
    period: Duration,
    next: Instant,
}

impl Pace {
    fn wait(&mut self) {
        let now = Instant::now();
        std::thread::sleep(self.next.saturating_duration_since(now));
        let late = now.saturating_duration_since(self.next).as_nanos() / self.period.as_nanos();
        self.next += self.period * (late as u32 + 1);
    }
}

impl Open {
    /// Opens the GPU for a window that is in its place, and finds out how its flips can be known.
    pub(super) fn new(opening: Opening) -> Result<Self, Fault> {
        let Opening { want, display, place, window, id, mut watch, .. } = opening;
        let mut gpu = Gpu::new(window.clone(), place.width, place.height)?;
        let mut findings = display.findings.clone();
        let hz = display.refresh_hz.or(want.refresh_hz).unwrap_or_else(|| {
            findings.push(format!(
                "{} does not tell its refresh rate; {USUAL_HZ} Hz is assumed",
                display.connector
            ));
            USUAL_HZ
        });
        let period = Duration::from_secs_f64(1.0 / hz.clamp(1.0, 1000.0));
        let (method, evidence) = probe(&mut gpu, &mut watch, place, &mut findings)?;
        let hello = hello(&display, place, period, &gpu, method, findings);
        let pace = Pace { period, next: Instant::now() };
        let slides = Vec::new();
        let doubted = false;
        Ok(Self { want, place, window, id, watch, gpu: Some(gpu), slides, evidence, hello, pace, doubted })
    }

    /// What is known of the window.
    pub(super) fn hello(&self) -> &Hello {
        &self.hello
    }

    /// Whether it is what another client asks for, and still in its place.
    pub(super) fn is_as(&mut self, want: &Want) -> bool {
        self.doubted = true;
        self.want == *want && self.watch.forget().is_ok() && self.check().is_ok()
    }

    /// Something happened to the window: it is looked at before the next picture.
    pub(super) fn doubt(&mut self) {
        self.doubted = true;
    }

    /// Replaces the slides.
    pub(super) fn load(&mut self, slides: Vec<Slide>) -> Result<(), Fault> {
        self.doubted = true;
        self.watch.forget()?;
        self.check()?;
        self.slides = slides;
        self.with_gpu(|gpu, slides| gpu.load(slides))
    }

    /// Shows a slide, or black, and waits until it is known to be on its way to the glass.
    pub(super) fn show(&mut self, slide: Option<u32>) -> Result<Shown, Fault> {
        for _ in 0..2 {
            self.watch.forget()?;
            // Black is right wherever the window is, and whatever covers it.
            if slide.is_some() {
                self.check()?;
            }
            if self.hello.method == ReceiptMethod::Guessed {
                self.pace.wait();
            }
            self.with_gpu(|gpu, _| gpu.present(slide))?;
            if let Some(shown) = self.receipt(slide)? {
                return Ok(shown);
            }
        }
        Err(Fault::Unavailable("the display skips pictures: another program presents to it as well".into()))
    }

    /// The evidence of the picture that was just handed over; `None` where the display skipped it.
    fn receipt(&mut self, slide: Option<u32>) -> Result<Option<Shown>, Fault> {
        let seen = match self.evidence {
            Evidence::Return => Some(Seen::Drawn),
            _ => self.watch.wait(self.place.pixels(), Instant::now() + SHOW)?,
        };
        let seen = seen.ok_or(Fault::Timeout(SHOW.as_millis() as u64))?;
        Ok(shown(slide, seen, self.hello.method, monotonic_ns()))
    }

    /// Looks whether the window still covers its display, where there is doubt.
    fn check(&mut self) -> Result<(), Fault> {
        if self.watch.take_change() | std::mem::take(&mut self.doubted) {
            // Until it has been found well it stays in doubt.
            self.doubted = true;
            let (display, place) = self.watch.choose(&self.want)?;
            let found = self.watch.place(self.id)?;
            if place != self.place || found != Some(self.place) {
                let is = found.map_or("nowhere".into(), written);
                return Err(Fault::Unavailable(format!(
                    "{} has changed: it is at {}, the window at {is}, and pictures were made for {}",
                    display.connector,
                    written(place),
                    written(self.place)
                )));
            }
            self.doubted = false;
        }
        if self.watch.is_obscured() {
            let detail = "another window covers part of the projector's; close it or move it away";
            return Err(Fault::Unavailable(detail.into()));
        }
        Ok(())
    }

    /// Does something on the GPU; where it is lost, opens it again and does it once more.
    fn with_gpu(
        &mut self,
        mut work: impl FnMut(&mut Gpu, &[Slide]) -> Result<(), Fault>,
    ) -> Result<(), Fault> {
        if let Some(gpu) = &mut self.gpu {
            let done = work(gpu, &self.slides);
            if done.is_ok() || !gpu.is_lost() {
                return done;
            }
        }
        // Of one window there can be one surface.
        self.gpu = None;
        let mut gpu = Gpu::new(self.window.clone(), self.place.width, self.place.height)?;
        gpu.load(&self.slides)?;
        let done = work(&mut gpu, &self.slides);
        self.gpu = Some(gpu);
        done
    }
}

/// The receipt of a picture of which this was seen; `None` where it was skipped. Only a flip at a believable time is
/// proof, and only on a display that flips reach without a detour.
fn shown(slide: Option<u32>, seen: Seen, method: ReceiptMethod, now_ns: u64) -> Option<Shown> {
    let guessed = Shown { slide, flipped_ns: now_ns, refresh: None, method: ReceiptMethod::Guessed };
    let Seen::Completed { msc, ust, how } = seen else { return Some(guessed) };
    let flipped_ns = ust.saturating_mul(1000);
    let is_ours = u128::from(now_ns.abs_diff(flipped_ns)) < CLOCK_SLACK.as_nanos();
    match how {
        How::Skip => None,
        How::Flip if method == ReceiptMethod::X11Present && is_ours => {
            Some(Shown { slide, flipped_ns, refresh: Some(msc), method })
        }
        _ => Some(guessed),
    }
}

/// Shows black a few times and sees what the server tells of it.
fn probe(
    gpu: &mut Gpu,
    watch: &mut Watch,
    place: Place,
    findings: &mut Vec<String>,
) -> Result<(ReceiptMethod, Evidence), Fault> {
    let (mut last, mut silent) = (None, 0);
    for _ in 0..PROBES {
        watch.forget()?;
        gpu.present(None)?;
        last = watch.wait(place.pixels(), Instant::now() + PROBE)?;
        silent = if last.is_none() { silent + 1 } else { 0 };
        if silent == SILENT {
            break;
        }
    }
    let doubt = doubt(last, watch.between()?);
    if let Some(reason) = &doubt {
        findings.push(format!("times of flips are only guessed: {reason}"));
    }
    if last.is_some() {
        let method = if doubt.is_none() { ReceiptMethod::X11Present } else { ReceiptMethod::Guessed };
        return Ok((method, Evidence::Completion));
    }
    if watch.watch_drawing()? {
        gpu.present(None)?;
        if watch.wait(place.pixels(), Instant::now() + SHOW)?.is_some() {
            return Ok((ReceiptMethod::Guessed, Evidence::Drawing));
        }
    }
    Ok((ReceiptMethod::Guessed, Evidence::Return))
}

/// Why flips cannot be known by what was `seen` of pictures, with what stands `between` server and glass; `None` where
/// they can.
fn doubt(seen: Option<Seen>, between: Option<String>) -> Option<String> {
    between.or_else(|| match seen {
        Some(Seen::Completed { how: How::Flip, .. }) => None,
        Some(Seen::Completed { .. }) => {
            Some("the X server copies pictures instead of switching to them".into())
        }
        _ => Some("the X server tells none, as one without a display does".into()),
    })
}

fn hello(
    display: &Display,
    place: Place,
    period: Duration,
    gpu: &Gpu,
    method: ReceiptMethod,
    findings: Vec<String>,
) -> Hello {
    Hello {
        version: VERSION,
        connector: display.connector.clone(),
        model: display.model(),
        width: place.width,
        height: place.height,
        period_ns: period.as_nanos() as u64,
        format: gpu.format(),
        adapter: gpu.adapter().to_owned(),
        method,
        findings,
    }
}

/// The machine's monotonic clock, which the X server's `ust` is read from as well.
fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn completed(how: How, ust: u64) -> Seen {
        Seen::Completed { msc: 77, ust, how }
    }

    #[test]
    fn only_a_flip_at_a_believable_time_is_proof() {
        use ReceiptMethod::{Guessed, X11Present};
        let now_ns = 50_000_000_000;
        let receipt = |seen, method| shown(Some(3), seen, method, now_ns);
        let guess = Shown { slide: Some(3), flipped_ns: now_ns, refresh: None, method: Guessed };
        let proof = Shown { flipped_ns: 49_999_000_000, refresh: Some(77), method: X11Present, ..guess };
        let flip = completed(How::Flip, 49_999_000);
        assert_eq!(receipt(flip, X11Present), Some(proof));
        // A compositor in between makes even flips a guess; so does a time of another clock.
        assert_eq!(receipt(flip, Guessed), Some(guess));
        assert_eq!(receipt(completed(How::Flip, 40_000_000), X11Present), Some(guess));
        assert_eq!(receipt(completed(How::Flip, u64::MAX), X11Present), Some(guess));
        assert_eq!(receipt(completed(How::Copy, 49_999_000), X11Present), Some(guess));
        assert_eq!(receipt(Seen::Drawn, Guessed), Some(guess));
        assert_eq!(receipt(completed(How::Skip, 49_999_000), X11Present), None);
    }

    #[test]
    fn what_makes_flips_a_guess_is_named() {
        let flip = Some(completed(How::Flip, 1));
        assert_eq!(doubt(flip, None), None);
        assert_eq!(doubt(flip, Some("a compositor".into())), Some("a compositor".into()));
        assert!(doubt(Some(completed(How::Copy, 1)), None).is_some_and(|reason| reason.contains("copies")));
        assert!(doubt(None, None).is_some_and(|reason| reason.contains("tells none")));
    }

    #[test]
    fn the_own_clock_keeps_its_phase_however_late_one_comes() {
        let period = Duration::from_millis(2);
        let start = Instant::now();
        let mut pace = Pace { period, next: start };
        for pause in [0, 0, 5, 0, 3] {
            std::thread::sleep(Duration::from_millis(pause));
            let came = Instant::now();
            let due = pace.next;
            pace.wait();
            assert!(Instant::now() >= due);
            assert_eq!((pace.next - start).as_nanos() % period.as_nanos(), 0);
            assert!(pace.next > came);
        }
    }
}
