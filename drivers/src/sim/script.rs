//! What goes wrong on a simulated rig, as its description says. Each fault happens at the place where it does on a real
//! rig, and the drivers report no more of it than those of a real one would.

use serde::{Deserialize, Serialize};

use super::{faults::Faults, scene::Scene};
use crate::clock::Timestamp;

/// Longest time of a script in ms.
const LONGEST_MS: f64 = 3.6e6;

/// One thing that goes wrong, an entry of `[[sim.faults]]`.
///
/// `frame` counts the exposures since the camera was armed, from 0, takes that are repeated included; `count` is for how
/// many of them in a row (1 by default). `slide` counts the loaded slides from 0. Times start when the camera is armed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum FaultDescription {
    /// Delivery: exposures that never arrive.
    DroppedFrame {
        /// First of them.
        frame: u64,
        /// How many.
        #[serde(default = "one")]
        count: u64,
    },
    /// Delivery: exposures that arrive late, and hold up those behind them.
    LateFrame {
        /// First of them.
        frame: u64,
        /// How many.
        #[serde(default = "one")]
        count: u64,
        /// By how much.
        by_ms: f64,
    },
    /// Delivery: exposures that arrive twice.
    DuplicateFrame {
        /// First of them.
        frame: u64,
        /// How many.
        #[serde(default = "one")]
        count: u64,
    },
    /// Delivery: a buffer is handed out before it is filled, so that it holds the picture before under the new stamp.
    StaleFrame {
        /// First of them.
        frame: u64,
        /// How many.
        #[serde(default = "one")]
        count: u64,
    },
    /// Delivery: a buffer is handed out half filled, so that from `row` on it holds the picture before.
    TornFrame {
        /// First of them.
        frame: u64,
        /// How many.
        #[serde(default = "one")]
        count: u64,
        /// First image row of the old picture.
        row: u32,
    },
    /// Sensor: a row that does not answer to light.
    DeadRow {
        /// Row of the sensor.
        row: u32,
    },
    /// Camera: exposure time follows the mean of the frame before, whatever the applied settings say.
    AutoExposure {
        /// Mean that it strives for, as a share of full scale above black.
        #[serde(default = "a_third")]
        target: f64,
        /// Share of the (logarithmic) error that each frame corrects.
        #[serde(default = "a_third")]
        speed: f64,
    },
    /// Camera: a look-up table that bends the response, `dn ~ signal^exponent`, while the settings read back a gamma of 1.
    HiddenGamma {
        /// Exponent.
        exponent: f64,
    },
    /// Display: where slide `slide` is asked for, the next one is shown, and the other way round.
    ExchangedSlides {
        /// First of the two.
        slide: u32,
    },
    /// Display: from slide `slide` on, the slide `by` before the one asked for is shown.
    DelayedSlides {
        /// First slide that comes late.
        slide: u32,
        /// By how many.
        by: u32,
    },
    /// Display: cold liquid crystals that take longer than the projector's info says.
    SlowLcd {
        /// Time of the middle 80 % of a change.
        lcd_10_90_ms: f64,
    },
    /// Display: signal processing that takes longer than the projector's info says.
    ExtraLatency {
        /// Refreshes on top of the stated ones.
        refreshes: u32,
    },
    /// Lamp: another brightness for a while.
    LampBurst {
        /// From when.
        at_ms: f64,
        /// How long.
        for_ms: f64,
        /// Change as a share of the mean.
        share: f64,
    },
    /// Lamp: a steady change, as of one that warms up.
    LampDrift {
        /// Change as a share of the mean...
        share: f64,
        /// ...in this time, after which it stays.
        over_ms: f64,
    },
    /// Room: the ambient light changes.
    AmbientChange {
        /// When it begins.
        at_ms: f64,
        /// How long it takes.
        #[serde(default)]
        over_ms: f64,
        /// Electrons per pixel at the reference exposure, afterwards.
        electrons: f64,
    },
    /// Scene: an object is pushed.
    BumpedObject {
        /// When.
        at_ms: f64,
        /// Its name.
        object: String,
        /// Where to.
        by_mm: [f64; 3],
    },
    /// Rig: the camera is knocked.
    BumpedCamera {
        /// When.
        at_ms: f64,
        /// Shift of its centre, in its frame.
        #[serde(default)]
        by_mm: [f64; 3],
        /// Turn about its axes x, y, z (applied in this order) in degrees.
        #[serde(default)]
        turn_deg: [f64; 3],
    },
}

fn one() -> u64 {
    1
}

fn a_third() -> f64 {
    1.0 / 3.0
}

impl FaultDescription {
    /// Adds what is wrong with it, below `key`.
    pub(crate) fn validate(&self, faults: &mut Faults, key: &str) {
        let mut time =
            |name: &str, value: f64| faults.within(&format!("{key}.{name}"), value, 0.0, LONGEST_MS);
        match *self {
            Self::LateFrame { by_ms, .. } => time("by_ms", by_ms),
            Self::LampBurst { at_ms, for_ms, share } => {
                time("at_ms", at_ms);
                time("for_ms", for_ms);
                faults.within(&format!("{key}.share"), share, -1.0, 10.0);
            }
            Self::LampDrift { share, over_ms } => {
                time("over_ms", over_ms);
                faults.within(&format!("{key}.share"), share, -1.0, 10.0);
            }
            Self::AmbientChange { at_ms, over_ms, electrons } => {
                time("at_ms", at_ms);
                time("over_ms", over_ms);
                faults.at_least(&format!("{key}.electrons"), electrons, 0.0);
            }
            Self::BumpedObject { at_ms, ref object, by_mm } => {
                time("at_ms", at_ms);
                finite(faults, &format!("{key}.by_mm"), by_mm);
                if object.is_empty() {
                    faults.add(&format!("{key}.object"), "names no object of the scene");
                }
            }
            Self::BumpedCamera { at_ms, by_mm, turn_deg } => {
                time("at_ms", at_ms);
                finite(faults, &format!("{key}.by_mm"), by_mm);
                finite(faults, &format!("{key}.turn_deg"), turn_deg);
            }
            Self::AutoExposure { target, speed } => {
                faults.within(&format!("{key}.target"), target, 0.01, 1.0);
                faults.within(&format!("{key}.speed"), speed, 0.0, 1.0);
            }
            Self::HiddenGamma { exponent } => faults.within(&format!("{key}.exponent"), exponent, 0.1, 5.0),
            Self::SlowLcd { lcd_10_90_ms } => {
                faults.within(&format!("{key}.lcd_10_90_ms"), lcd_10_90_ms, 0.0, 1e4);
            }
            Self::ExtraLatency { refreshes } if refreshes > 1000 => {
                faults.add(&format!("{key}.refreshes"), &format!("is {refreshes}, must be at most 1000"));
            }
            Self::DroppedFrame { .. }
            | Self::DuplicateFrame { .. }
            | Self::StaleFrame { .. }
            | Self::TornFrame { .. }
            | Self::DeadRow { .. }
            | Self::ExchangedSlides { .. }
            | Self::DelayedSlides { .. }
            | Self::ExtraLatency { .. } => {}
        }
    }
}

fn finite(faults: &mut Faults, key: &str, values: [f64; 3]) {
    for (axis, value) in values.into_iter().enumerate() {
        faults.finite(&format!("{key}[{axis}]"), value);
    }
}

/// What happens to one exposure on its way from the sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Delivered {
    Whole,
    Never,
    Twice,
    /// The picture before.
    Stale,
    /// The picture before from this image row on.
    Torn(u32),
}

/// Automatic exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct AutoExposure {
    pub(crate) target: f64,
    pub(crate) speed: f64,
}

/// A change of position.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Bump {
    Object { name: String, by_mm: [f64; 3] },
    Camera { by_mm: [f64; 3], turn_deg: [f64; 3] },
}

/// All faults of a rig, asked by the places where they happen.
#[derive(Debug, Clone, Default)]
pub(crate) struct Script {
    faults: Vec<FaultDescription>,
}

fn among(frame: u64, first: u64, count: u64) -> bool {
    frame >= first && frame - first < count
}

impl Script {
    pub(crate) fn new(faults: &[FaultDescription]) -> Self {
        Self { faults: faults.to_vec() }
    }

    /// Faults that name what the scene does not have.
    pub(crate) fn check_scene(&self, scene: &Scene) -> Vec<String> {
        let unknown = self.faults.iter().enumerate().filter_map(|(number, fault)| match fault {
            FaultDescription::BumpedObject { object, .. }
                if !scene.objects.iter().any(|other| other.name == *object) =>
            {
                Some(format!("sim.faults[{number}].object: the scene has no object `{object}`"))
            }
            _ => None,
        });
        unknown.collect()
    }

    /// Fate of exposure `frame`. Of several faults the first counts.
    pub(crate) fn delivered(&self, frame: u64) -> Delivered {
        let fate = self.faults.iter().find_map(|fault| match *fault {
            FaultDescription::DroppedFrame { frame: first, count } if among(frame, first, count) => {
                Some(Delivered::Never)
            }
            FaultDescription::DuplicateFrame { frame: first, count } if among(frame, first, count) => {
                Some(Delivered::Twice)
            }
            FaultDescription::StaleFrame { frame: first, count } if among(frame, first, count) => {
                Some(Delivered::Stale)
            }
            FaultDescription::TornFrame { frame: first, count, row } if among(frame, first, count) => {
                Some(Delivered::Torn(row))
            }
            _ => None,
        });
        fate.unwrap_or(Delivered::Whole)
    }

    /// How much later than its readout exposure `frame` arrives, in s.
    pub(crate) fn delay_s(&self, frame: u64) -> f64 {
        let late = self.faults.iter().map(|fault| match *fault {
            FaultDescription::LateFrame { frame: first, count, by_ms } if among(frame, first, count) => {
                1e-3 * by_ms
            }
            _ => 0.0,
        });
        late.sum()
    }

    /// Whether a row of the sensor is dead.
    pub(crate) fn is_dead(&self, sensor_row: u32) -> bool {
        self.faults
            .iter()
            .any(|fault| matches!(*fault, FaultDescription::DeadRow { row } if row == sensor_row))
    }

    pub(crate) fn auto_exposure(&self) -> Option<AutoExposure> {
        self.faults.iter().find_map(|fault| match *fault {
            FaultDescription::AutoExposure { target, speed } => Some(AutoExposure { target, speed }),
            _ => None,
        })
    }

    /// Exponent that is not told to anybody.
    pub(crate) fn hidden_gamma(&self) -> f64 {
        let exponents = self.faults.iter().map(|fault| match *fault {
            FaultDescription::HiddenGamma { exponent } => exponent,
            _ => 1.0,
        });
        exponents.product()
    }

    /// The slide that is shown where `slide` of `slides` is asked for.
    pub(crate) fn shown(&self, slide: u32, slides: u32) -> u32 {
        self.faults.iter().fold(slide, |shown, fault| match *fault {
            FaultDescription::ExchangedSlides { slide: first } if shown == first && shown + 1 < slides => {
                shown + 1
            }
            FaultDescription::ExchangedSlides { slide: first } if first.checked_add(1) == Some(shown) => {
                first
            }
            FaultDescription::DelayedSlides { slide: first, by } if shown >= first => {
                shown.saturating_sub(by)
            }
            _ => shown,
        })
    }

    /// Time of the liquid crystals in truth, `stated` without a fault.
    pub(crate) fn lcd_10_90_ms(&self, stated: f64) -> f64 {
        let slow = self.faults.iter().rev().find_map(|fault| match *fault {
            FaultDescription::SlowLcd { lcd_10_90_ms } => Some(lcd_10_90_ms),
            _ => None,
        });
        slow.unwrap_or(stated)
    }

    pub(crate) fn extra_latency_refreshes(&self) -> u32 {
        let extra = self.faults.iter().map(|fault| match *fault {
            FaultDescription::ExtraLatency { refreshes } => refreshes,
            _ => 0,
        });
        extra.sum()
    }

    /// Times after arming at which the lamp jumps, in ns.
    pub(crate) fn lamp_jumps_ns(&self) -> Vec<u64> {
        let mut jumps = Vec::new();
        for fault in &self.faults {
            if let FaultDescription::LampBurst { at_ms, for_ms, .. } = *fault {
                jumps.extend([nanoseconds(at_ms), nanoseconds(at_ms + for_ms)]);
            }
        }
        jumps
    }

    /// Factor of the lamp `ns` after arming (negative: before), between two jumps.
    pub(crate) fn lamp(&self, ns: f64) -> f64 {
        let ms = 1e-6 * ns;
        let factors = self.faults.iter().map(|fault| match *fault {
            FaultDescription::LampBurst { at_ms, for_ms, share } if ms >= at_ms && ms < at_ms + for_ms => {
                1.0 + share
            }
            FaultDescription::LampDrift { share, over_ms } => 1.0 + share * progress(ms, 0.0, over_ms),
            _ => 1.0,
        });
        factors.product()
    }

    /// Ambient electrons `ns` after arming where `before` is their number before.
    pub(crate) fn ambient_e(&self, ns: f64, before: f64) -> f64 {
        self.faults.iter().fold(before, |now, fault| match *fault {
            FaultDescription::AmbientChange { at_ms, over_ms, electrons } => {
                now + (electrons - now) * progress(1e-6 * ns, at_ms, over_ms)
            }
            _ => now,
        })
    }

    /// The first bump: when (ns after arming), and what.
    pub(crate) fn bump(&self) -> Option<(u64, Bump)> {
        self.faults.iter().find_map(|fault| match fault {
            FaultDescription::BumpedObject { at_ms, object, by_mm } => {
                Some((nanoseconds(*at_ms), Bump::Object { name: object.clone(), by_mm: *by_mm }))
            }
            FaultDescription::BumpedCamera { at_ms, by_mm, turn_deg } => {
                Some((nanoseconds(*at_ms), Bump::Camera { by_mm: *by_mm, turn_deg: *turn_deg }))
            }
            _ => None,
        })
    }
}

/// `time` after `armed` in ns, negative before.
pub(crate) fn since_ns(time: Timestamp, armed: Timestamp) -> f64 {
    time.0 as f64 - armed.0 as f64
}

fn nanoseconds(ms: f64) -> u64 {
    (1e6 * ms).round() as u64
}

/// From 0 at `from` to 1 after `over`.
fn progress(now: f64, from: f64, over: f64) -> f64 {
    if over > 0.0 { ((now - from) / over).clamp(0.0, 1.0) } else { f64::from(u8::from(now >= from)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn script(text: &str) -> Script {
        #[derive(Deserialize)]
        struct File {
            faults: Vec<FaultDescription>,
        }
        Script::new(&toml::from_str::<File>(text).unwrap().faults)
    }

    #[test]
    fn each_place_is_told_its_own_faults() {
        let script = script(
            r#"
            [[faults]]
            kind = "dropped-frame"
            frame = 3
            count = 2
            [[faults]]
            kind = "torn-frame"
            frame = 4
            row = 7
            [[faults]]
            kind = "late-frame"
            frame = 9
            by_ms = 250.0
            [[faults]]
            kind = "exchanged-slides"
            slide = 4
            [[faults]]
            kind = "delayed-slides"
            slide = 8
            by = 2
            [[faults]]
            kind = "lamp-burst"
            at_ms = 10.0
            for_ms = 5.0
            share = -0.5
            [[faults]]
            kind = "ambient-change"
            at_ms = 100.0
            over_ms = 10.0
            electrons = 40.0
            "#,
        );
        let fates: Vec<Delivered> = (2..7).map(|frame| script.delivered(frame)).collect();
        // The first fault that names a frame decides.
        let never = Delivered::Never;
        assert_eq!(fates, [Delivered::Whole, never, never, Delivered::Whole, Delivered::Whole]);
        assert_eq!((script.delay_s(8), script.delay_s(9)), (0.0, 0.25));
        let shown: Vec<u32> = (3..12).map(|slide| script.shown(slide, 12)).collect();
        assert_eq!(shown, [3, 5, 4, 6, 7, 6, 7, 8, 9]);
        assert_eq!(script.lamp_jumps_ns(), [10_000_000, 15_000_000]);
        assert_eq!([-1.0, 9e6, 12e6, 15e6].map(|ns| script.lamp(ns)), [1.0, 1.0, 0.5, 1.0]);
        assert_eq!([0.0, 105e6, 1e9].map(|ns| script.ambient_e(ns, 20.0)), [20.0, 30.0, 40.0]);
        assert_eq!(script.hidden_gamma(), 1.0);
        assert!(script.bump().is_none() && script.auto_exposure().is_none() && !script.is_dead(3));
    }

    #[test]
    fn the_last_slide_has_none_to_be_exchanged_with() {
        let script = script("faults = [{ kind = \"exchanged-slides\", slide = 5 }]");
        assert_eq!((script.shown(5, 6), script.shown(5, 7), script.shown(6, 7)), (5, 6, 5));
    }

    #[test]
    fn unknown_kinds_and_keys_are_refused() {
        for text in ["kind = \"gremlins\"", "kind = \"dead-row\"\nrow = 1\ncolumn = 2", "kind = \"dead-row\""]
        {
            assert!(toml::from_str::<FaultDescription>(text).is_err(), "{text}");
        }
    }
}
