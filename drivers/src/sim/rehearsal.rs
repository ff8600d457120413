//! Frames of a schedule, rendered before the clock of its scan starts.
//!
//! The timeline is played ahead on a copy. A rendered frame is handed out only for an exposure that turns out to be the
//! same, light, noise and all: a rehearsal can save time but never change what a frame shows.

use std::{collections::HashMap, sync::Arc, time::Duration};

use super::{
    camera::light,
    render::{Exposure, Response},
    rig::Shared,
    timeline::Timeline,
};
use crate::{
    camera::Schedule,
    clock::Timestamp,
    frame::{PixelStore, Pixels},
    projector::Slide,
};

/// Memory that rehearsed frames of one scan may take: 130 of 1600 x 1200 px of 16 bits. Whoever captures keeps them
/// anyway, as they come.
pub const REHEARSED_BYTES: usize = 512 << 20;

/// Refreshes of black before the first slide of a rehearsal: what was on the glass before has faded.
const REFRESHES_AHEAD: u64 = 100;

/// A schedule and its frames so far.
pub(crate) struct Rehearsal {
    schedule: Schedule,
    response: Response,
    slides: Vec<Arc<Slide>>,
    timeline: Timeline,
    /// Number of the first exposure.
    first: u64,
    /// First flip, in refreshes.
    refresh: u64,
    done: usize,
    bytes: usize,
    /// Frames that were asked for exactly so.
    used: u64,
    frames: HashMap<u64, (Exposure, Arc<dyn PixelStore>)>,
}

impl std::fmt::Debug for Rehearsal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Rehearsal").field("schedule", &self.schedule).field("done", &self.done).finish()
    }
}

/// Renders the next frame of `schedule`, the first one where the latest rehearsal was for something else; how many are
/// left.
pub(crate) fn step(shared: &Shared, response: &Response, schedule: &Schedule) -> usize {
    // Its exposure depends on the frames before.
    if shared.script.auto_exposure().is_some() {
        return 0;
    }
    let mut held = shared.rehearsed();
    let same = held.as_ref().is_some_and(|rehearsal| rehearsal.is_of(shared, response, schedule));
    if !same {
        *held = Some(Rehearsal::new(shared, response, schedule));
    }
    held.as_mut().map_or(0, |rehearsal| rehearsal.step(shared))
}

impl Rehearsal {
    fn new(shared: &Shared, response: &Response, schedule: &Schedule) -> Self {
        let mut timeline = shared.timeline().clone();
        let period = timeline.period_ns();
        let refresh = shared.clock.now().0 / period + REFRESHES_AHEAD;
        timeline.flip(shared.clock.now(), None);
        // A camera is armed just before the first flip.
        timeline.arm(Timestamp((refresh - 1) * period));
        Self {
            schedule: *schedule,
            response: response.clone(),
            slides: shared.loaded(),
            timeline,
            first: shared.coming_exposure(),
            refresh,
            done: 0,
            bytes: 0,
            used: 0,
            frames: HashMap::new(),
        }
    }

    fn is_of(&self, shared: &Shared, response: &Response, schedule: &Schedule) -> bool {
        let loaded = shared.loaded();
        (&self.schedule, &self.response, self.first) == (schedule, response, shared.coming_exposure())
            && self.slides.len() == loaded.len()
            && self.slides.iter().zip(&loaded).all(|(ours, theirs)| Arc::ptr_eq(ours, theirs))
    }

    fn step(&mut self, shared: &Shared) -> usize {
        let wanted = self.schedule.slides.min(self.slides.len());
        if self.done >= wanted || self.bytes >= REHEARSED_BYTES {
            return 0;
        }
        let (number, index) = (self.first + self.done as u64, self.done as u32);
        let shown = shared.script.shown(index, self.slides.len() as u32) as usize;
        let period = self.timeline.period_ns();
        let refresh = self.refresh + self.done as u64 * u64::from(self.schedule.hold_refreshes);
        let slide = self.slides.get(shown).cloned();
        let (_, flipped) = self.timeline.flip(Timestamp(refresh * period - 1), slide);
        let start = flipped + self.schedule.trigger_delay;
        let end = start + Duration::from_secs_f64(1e-6 * self.response.exposure_us);
        let exposure = light(shared, &self.timeline, number, [start, end]);
        let store = shared.renderer.render(&exposure, &self.response);
        self.bytes += match store.pixels() {
            Pixels::U8(samples) => samples.len(),
            Pixels::U16(samples) => 2 * samples.len(),
        };
        self.frames.insert(number, (exposure, store));
        self.done += 1;
        if self.bytes >= REHEARSED_BYTES { 0 } else { wanted - self.done }
    }

    /// The frame of `exposure`, where it has been rendered exactly so.
    pub(crate) fn take(&mut self, exposure: &Exposure, response: &Response) -> Option<Arc<dyn PixelStore>> {
        let (rehearsed, store) = self.frames.remove(&exposure.number)?;
        let same = self.response == *response && rehearsed.is_same_as(exposure);
        self.used += u64::from(same);
        same.then_some(store)
    }

    /// How many frames were as rehearsed.
    pub(crate) fn used(&self) -> u64 {
        self.used
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::{Camera, CameraDriver, CameraSettings, PixelFormat, TriggerSource},
        clock::{Clock, VirtualClock},
        projector::{Projector, ProjectorDriver},
        sim::{FaultDescription, Pacing, Rig, Scene, testing::small_rig},
    };

    const SLIDES: usize = 5;
    const SCHEDULE: Schedule =
        Schedule { slides: SLIDES, hold_refreshes: 3, trigger_delay: Duration::from_millis(30) };

    struct Devices {
        clock: Arc<VirtualClock>,
        camera: Box<dyn Camera>,
        projector: Box<dyn Projector>,
    }

    fn devices(pacing: Pacing, faults: Vec<FaultDescription>) -> Devices {
        let mut description = small_rig();
        description.pacing = pacing;
        description.camera.read_noise_e = 2.3;
        description.projector.lcd_10_90_ms = 4.0;
        description.faults = faults;
        let scene: Scene = toml::from_str(
            "materials.card.diffuse = 0.8\n[[objects]]\nname = \"card\"\nmaterial = \"card\"\nlevel = 0.8\n\
             shape = { plane = { point_mm = [0.0, 0.0, 1000.0], normal = [0.0, 0.0, -1.0] } }",
        )
        .unwrap();
        let clock = Arc::new(VirtualClock::default());
        let rig = Rig::new(&description, &scene, clock.clone()).unwrap();
        let mut camera = rig.cameras().open(None).unwrap();
        let mut projector = rig.projectors().open(None).unwrap();
        let slides: Vec<Slide> = (0..SLIDES as u8).map(|n| Slide::Uniform([0, 40 * n, 0])).collect();
        projector.load(&slides).unwrap();
        camera
            .apply(&CameraSettings {
                exposure_us: 2000.0,
                gain_db: 0.0,
                gamma: 1.0,
                region: None,
                format: PixelFormat::Mono12,
                trigger: TriggerSource::Software,
            })
            .unwrap();
        Devices { clock, camera, projector }
    }

    impl Devices {
        fn rehearse(&mut self) -> Vec<usize> {
            let left = || self.camera.rehearse(&SCHEDULE).unwrap();
            std::iter::repeat_with(left).take_while(|left| *left > 0).collect()
        }

        /// Takes the frames of the schedule, that of slide `late` a little later; how many were as rehearsed.
        fn capture(&mut self, late: Option<usize>) -> (Vec<Vec<u16>>, Option<u64>) {
            self.camera.arm(SLIDES).unwrap();
            let period = self.projector.info().refresh_period;
            let mut frames = Vec::new();
            let mut due = self.clock.now();
            for slide in 0..SLIDES {
                self.clock.sleep_until(due);
                let flipped = self.projector.show(slide as u32).unwrap().flipped;
                due = flipped + period * 2 + period / 4;
                let delay = Duration::from_millis(if late == Some(slide) { 31 } else { 30 });
                self.camera.trigger(flipped + delay).unwrap();
                let frame = self.camera.next_frame(Duration::from_secs(5)).unwrap();
                match frame.pixels() {
                    Pixels::U16(samples) => frames.push(samples.to_vec()),
                    Pixels::U8(_) => panic!("12 bits were configured"),
                }
            }
            // As after every capture: what is on the glass before the first slide is black.
            self.projector.black().unwrap();
            self.clock.sleep_until(self.clock.now() + Duration::from_secs(1));
            let statistics = self.camera.disarm().unwrap();
            (frames, statistics.counters.get("rehearsed_frames").copied())
        }
    }

    #[test]
    fn rehearsed_frames_are_those_that_would_have_been_rendered() {
        let mut fast = devices(Pacing::Fast, Vec::new());
        assert_eq!(fast.rehearse(), [], "a virtual clock waits");
        let (expected, none) = fast.capture(None);
        assert_eq!(none, None);
        let mut slow = devices(Pacing::RealTime, Vec::new());
        assert_eq!(slow.rehearse(), [4, 3, 2, 1]);
        let (frames, used) = slow.capture(None);
        assert!(frames == expected);
        assert_eq!(used, Some(SLIDES as u64));
        // A second scan has other noise, and is rehearsed anew.
        assert_eq!(slow.rehearse().len(), 4);
        let (again, used) = slow.capture(None);
        assert!(again == fast.capture(None).0 && again != expected);
        assert_eq!(used, Some(SLIDES as u64));
    }

    #[test]
    fn what_comes_otherwise_is_rendered_when_it_comes() {
        let expected = devices(Pacing::Fast, Vec::new()).capture(Some(2)).0;
        let mut slow = devices(Pacing::RealTime, Vec::new());
        slow.rehearse();
        let (frames, used) = slow.capture(Some(2));
        assert!(frames == expected);
        assert_eq!(used, Some(SLIDES as u64 - 1));
    }

    #[test]
    fn faults_of_the_display_are_rehearsed_too() {
        let faults = || {
            vec![
                FaultDescription::ExchangedSlides { slide: 1 },
                FaultDescription::ExtraLatency { refreshes: 1 },
            ]
        };
        let expected = devices(Pacing::Fast, faults()).capture(None).0;
        let mut slow = devices(Pacing::RealTime, faults());
        slow.rehearse();
        let (frames, used) = slow.capture(None);
        assert!(frames == expected);
        assert_eq!(used, Some(SLIDES as u64));
    }
}
