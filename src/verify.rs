//! The judge of a live capture: each pair is checked by its pair sum the moment it is complete, against the
//! references taken first.

use std::sync::Arc;

use polscan_drivers::frame::{Frame, PixelStore, Pixels};
use polscan_patterns::{Axis, Role, Sequence};

use crate::{
    decode::{
        CameraResponse, NoiseModel, PairContext, Plane, PlaneSource, SharedPlane, Thresholds, estimate_noise,
        pair_residual,
    },
    sequencer::{Judge, PairThresholds, PairVerdict, Suspicion, compare_references, drift_rule, judge_rule},
};

/// A frame as the decoder takes it, without a copy.
struct FramePlane(Arc<dyn PixelStore>);

impl PlaneSource for FramePlane {
    fn plane(&self) -> Plane<'_> {
        plane(self.0.pixels())
    }
}

fn plane(pixels: Pixels<'_>) -> Plane<'_> {
    match pixels {
        Pixels::U8(samples) => Plane::U8(samples),
        Pixels::U16(samples) => Plane::U16(samples),
    }
}

/// The pixels of a captured frame for the decoder; shares them.
pub fn shared_plane(frame: &Frame) -> SharedPlane {
    Arc::new(FramePlane(frame.store.clone()))
}

/// Judges pairs by their pair sum and last references by the first ones.
pub struct PairSumJudge {
    sequence: Sequence,
    camera: CameraResponse,
    thresholds: Thresholds,
    limits: PairThresholds,
    high: Option<Frame>,
    low: Option<Frame>,
    /// Pair against which the next one is compared where there are no two references, as in mode paper.
    first_pair: Option<[Frame; 2]>,
    noise: Option<NoiseModel>,
}

impl PairSumJudge {
    /// A judge for one capture of `sequence`.
    pub fn new(sequence: Sequence, camera: CameraResponse, thresholds: Thresholds) -> Self {
        Self {
            sequence,
            noise: camera.noise,
            camera,
            thresholds,
            limits: PairThresholds::default(),
            high: None,
            low: None,
            first_pair: None,
        }
    }

    /// Calibrated noise, or noise estimated from the first frames that sum to the same light.
    fn noise(&mut self, width: usize, frame: &Frame, inverse: &Frame) -> Option<NoiseModel> {
        if self.noise.is_none() {
            let earlier = match (&self.high, &self.low, &self.first_pair) {
                (Some(high), Some(low), _) => [high, low],
                (_, _, Some([first, second])) => [first, second],
                _ => return None,
            };
            let pairs = [earlier.map(|f| plane(f.pixels())), [frame, inverse].map(|f| plane(f.pixels()))];
            self.noise = estimate_noise(&pairs, width, &self.camera);
        }
        self.noise
    }
}

impl Judge for PairSumJudge {
    fn reference(&mut self, role: Role, frame: &Frame) {
        match role {
            Role::ReferenceH | Role::White => self.high = Some(frame.clone()),
            Role::ReferenceV | Role::Black => self.low = Some(frame.clone()),
            Role::Code { .. } => {}
        }
    }

    fn pair(&mut self, axis: Axis, bit: u8, frame: &Frame, inverse: &Frame) -> PairVerdict {
        let width = frame.width as usize;
        let noise = self.noise(width, frame, inverse);
        // Without two references the first pair takes their place: any pair sums to the same light.
        let (high, low) = match (&self.high, &self.low, &self.first_pair) {
            (Some(high), Some(low), _) => (high, low),
            (_, _, Some([first, second])) => (first, second),
            _ => {
                self.first_pair = Some([frame.clone(), inverse.clone()]);
                return PairVerdict::Accept;
            }
        };
        let residual = noise.and_then(|noise| {
            let context = PairContext {
                axis,
                bit,
                width,
                high: &[plane(high.pixels())],
                low: &[plane(low.pixels())],
                camera: self.camera,
                noise,
                lit_sigma: self.thresholds.lit_sigma,
            };
            pair_residual(plane(frame.pixels()), plane(inverse.pixels()), &context)
        });
        match residual {
            Some(residual) => judge_rule(&residual, self.sequence.code(axis).bits(), &self.limits),
            None => PairVerdict::Degraded(Suspicion {
                reason: "unverified-pair".into(),
                evidence: format!("{axis} bit {bit}: too little light to judge the pair"),
                sigma: 0.0,
            }),
        }
    }

    fn drift(&mut self, role: Role, first: &Frame, last: &Frame) -> PairVerdict {
        let change = self.noise.and_then(|noise| compare_references(first, last, &self.camera, noise));
        match change {
            Some(change) => drift_rule(role, &change, &self.limits),
            None => PairVerdict::Degraded(Suspicion {
                reason: "unverified-reference".into(),
                evidence: format!("{role}: too little light to compare it with the first"),
                sigma: 0.0,
            }),
        }
    }
}
