//! What the frames of a capture say together, in the order in which they were taken, and one pair alone cannot.

use polscan_drivers::frame::Frame;

use super::plane;
use crate::{
    decode::{CameraResponse, NoiseModel, Plane},
    evidence::{
        exposure::{self, Exposure, Gauge},
        settling,
    },
    sequencer::{PairVerdict, Suspicion},
};

/// Steps from frame to frame that automatic exposure is told by.
const EXPOSURE_STEPS: usize = 5;

/// What is wrong with the rig rather than with single frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Lasting {
    /// The camera adjusts itself to each picture.
    Automatic,
    /// Each frame has this share of the frame before.
    Rest(f64),
}

/// Frames so far, as far as they are needed.
#[derive(Default)]
pub(super) struct History {
    /// The bright reference that gains of frames are measured against: the first.
    gauge: Option<Frame>,
    /// Brightness of all frames of pairs, by the number of their trigger.
    exposures: Vec<(u64, Exposure)>,
    last: Option<Frame>,
    /// The last pair with the frame taken just before it.
    last_pair: Option<[Frame; 3]>,
    /// The rest that pairs had.
    rest: Option<f64>,
    /// Whether the camera was seen to adjust itself: it goes on to, also where its steps have become small.
    automatic: bool,
}

impl History {
    /// A frame of a reference; `bright`: of the brighter one.
    pub(super) fn reference(&mut self, frame: &Frame, bright: bool) {
        if bright && self.gauge.is_none() {
            self.gauge = Some(frame.clone());
        }
        self.last = Some(frame.clone());
    }

    /// The frames of a pair, and what all so far say.
    pub(super) fn pair(
        &mut self,
        frames: [&Frame; 2],
        camera: &CameraResponse,
        noise: Option<NoiseModel>,
    ) -> Option<Lasting> {
        self.automatic |= self.adjusts(frames, camera);
        self.settle(frames, camera, noise);
        if self.automatic { Some(Lasting::Automatic) } else { self.rest.map(Lasting::Rest) }
    }

    /// Whether the display was found not to settle.
    pub(super) fn is_unsettled(&self) -> bool {
        self.rest.is_some()
    }

    fn adjusts(&mut self, frames: [&Frame; 2], camera: &CameraResponse) -> bool {
        let Some(gauge) = &self.gauge else { return false };
        let gauge = Gauge {
            reference: plane(gauge.pixels()),
            black_dn: camera.black_level_dn.unwrap_or(0.0),
            saturation_dn: camera.saturation_dn,
        };
        let planes = frames.map(|frame| plane(frame.pixels()));
        for (frame, here, other) in [(frames[0], planes[0], planes[1]), (frames[1], planes[1], planes[0])] {
            let exposure = gauge.exposure(here, other, |_| true);
            self.exposures.extend(exposure.map(|exposure| (frame.stamp.trigger, exposure)));
        }
        let next = self.exposures.windows(2).filter(|two| two[1].0 == two[0].0 + 1);
        let steps: Vec<[f64; 2]> = next.map(|two| two[0].1.step_to(two[1].1)).collect();
        steps.len() >= EXPOSURE_STEPS
            && exposure::swings(self.exposures.iter().map(|(_, exposure)| *exposure))
            && exposure::answers(&steps)
    }

    /// Measures the rest by this pair and the one before it, where there is one and nothing was taken in between that is
    /// not known.
    fn settle(&mut self, frames: [&Frame; 2], camera: &CameraResponse, noise: Option<NoiseModel>) {
        let follows = |before: &&Frame| before.stamp.trigger + 1 == frames[0].stamp.trigger;
        let pair = self.last.as_ref().filter(follows).filter(|_| {
            // Its two frames as well.
            frames[0].stamp.trigger + 1 == frames[1].stamp.trigger
        });
        let pair = pair.map(|before| [before.clone(), frames[0].clone(), frames[1].clone()]);
        if let (Some(one), Some(other), Some(noise)) = (&self.last_pair, &pair, noise) {
            let planes = [one, other].map(|three| three.each_ref().map(|frame| plane(frame.pixels())));
            let black_dn = camera.black_level_dn.unwrap_or(0.0);
            let same = planes.iter().flatten().all(|plane: &Plane<'_>| plane.len() == planes[0][0].len());
            let rest = same.then(|| settling::rest(planes, noise, black_dn, camera.saturation_dn, |_| true));
            self.rest = rest.flatten().or(self.rest);
        }
        self.last_pair = pair.or(self.last_pair.take());
        self.last = Some(frames[1].clone());
    }
}

/// The verdict on a pair of a rig with such a fault: another take would show the same, and what it leaves can be as large as
/// what another picture does.
pub(super) fn lasting(verdict: PairVerdict, lasting: Lasting) -> PairVerdict {
    let PairVerdict::Retake(suspicion) = verdict else { return verdict };
    let (reason, words) = match lasting {
        Lasting::Automatic => (
            "exposure-drift",
            "each frame so far is the darker, the brighter the one before it was: the camera adjusts itself"
                .to_owned(),
        ),
        Lasting::Rest(share) => (
            "unsettled-display",
            format!(
                "each frame has a rest of {:.0} % of the frame before: the display does not settle",
                100.0 * share
            ),
        ),
    };
    let evidence = format!("{}; {words}", suspicion.evidence);
    PairVerdict::Degraded(Suspicion { reason: reason.into(), evidence, ..suspicion })
}
