//! The faults, and what each must be called.

use crate::rig::Rig;

/// A fault of the twin.
pub struct Case {
    /// Name in the table.
    pub name: &'static str,
    /// Mode of the scan, the configured one by default.
    pub mode: Option<&'static str>,
    /// What the live scan may call it: a diagnosis, why a picture was taken again, or `ok` where nothing is wrong.
    pub live: &'static [&'static str],
    /// What a decode of the frames alone may call it; empty: not judged.
    pub alone: &'static [&'static str],
    /// Puts the fault on a rig.
    pub build: fn(Rig, &mut Random) -> Rig,
}

/// Numbers that differ from seed to seed (SplitMix64).
pub struct Random {
    state: u64,
    scale: f64,
}

impl Random {
    /// Starts at a seed, for the paper's rig divided by `scale`.
    pub fn new(seed: u64, scale: f64) -> Self {
        Self { state: seed.wrapping_mul(0x9e37_79b9_7f4a_7c15), scale }
    }

    fn share(&mut self) -> f64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let word = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((word ^ (word >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.share()
    }

    /// A row of the camera, away from the rims.
    fn row(&mut self) -> u64 {
        (self.between(0.25, 0.75) * 1200.0 / self.scale) as u64
    }

    /// One of `low..high`.
    fn whole(&mut self, low: u64, high: u64) -> u64 {
        low + (self.share() * (high - low) as f64) as u64
    }
}

/// Exposures of the pairs: after the first references and before the last ones, at any size from a quarter up.
const FRAMES: [u64; 2] = [2, 30];

fn frame(random: &mut Random) -> u64 {
    random.whole(FRAMES[0], FRAMES[1])
}

fn at_frame(kind: &str, rest: &str, random: &mut Random) -> String {
    format!("kind = \"{kind}\", frame = {}{rest}", frame(random))
}

fn case(
    name: &'static str,
    live: &'static [&'static str],
    alone: &'static [&'static str],
    build: fn(Rig, &mut Random) -> Rig,
) -> Case {
    Case { name, mode: None, live, alone, build }
}

fn turned(rig: Rig, degrees: f64) -> Rig {
    rig.set("sim.analyser.azimuth_error_deg", degrees)
}

fn flickering(rig: Rig, share: f64, hz: f64) -> Rig {
    rig.set("sim.flicker.share", share).set("sim.flicker.hz", hz)
}

/// A frequency like that of the mains, off the multiples of the frame rate (15 Hz), at which a scan sees nothing of it.
fn mains(random: &mut Random) -> f64 {
    15.0 * random.whole(6, 8) as f64 + random.between(2.0, 13.0)
}

/// All of them.
pub fn all() -> Vec<Case> {
    let mut all = frames();
    all.extend(display());
    all.extend(light());
    all.extend(optics());
    all.extend(modes());
    all
}

fn frames() -> Vec<Case> {
    vec![
        case("nothing wrong", &["ok"], &["ok"], |rig, _| rig),
        case("dropped frame", &["lost-frame"], &["lost-frame"], |rig, random| {
            rig.fault(&at_frame("dropped-frame", "", random))
        }),
        // In the order of arrival nothing is wrong with frames that are only late.
        case("late frame", &["lost-frame"], &["ok"], |rig, random| {
            rig.fault(&at_frame("late-frame", ", by_ms = 400.0", random))
        }),
        case("duplicate frame", &["stale-frame", "duplicate-frame"], &["stale-frame"], |rig, random| {
            rig.fault(&at_frame("duplicate-frame", "", random))
        }),
        case("stale frame", &["stale-frame"], &["stale-frame"], |rig, random| {
            rig.fault(&at_frame("stale-frame", "", random))
        }),
        case("stale reference", &["stale-frame"], &["stale-frame"], |rig, _| {
            rig.fault("kind = \"stale-frame\", frame = 1")
        }),
        case("torn frame", &["torn-frame"], &["torn-frame"], |rig, random| {
            let row = random.row();
            rig.fault(&at_frame("torn-frame", &format!(", row = {row}"), random))
        }),
        case("dead sensor row", &["sensor-defect"], &["sensor-defect"], |rig, random| {
            let row = random.row();
            rig.fault(&format!("kind = \"dead-row\", row = {row}"))
        }),
    ]
}

fn display() -> Vec<Case> {
    vec![
        case("P and Q exchanged", &["swapped-frames"], &["swapped-frames"], |rig, random| {
            let slide = 2 + 2 * random.whole(0, 14);
            rig.fault(&format!("kind = \"exchanged-slides\", slide = {slide}"))
        }),
        case("sequence late by a pair", &["stale-frame"], &["stale-frame"], |rig, _| {
            rig.fault("kind = \"delayed-slides\", slide = 2, by = 2")
        }),
        case("sequence late by a pair from the middle", &["stale-frame"], &["stale-frame"], |rig, random| {
            let slide = 4 + 2 * random.whole(0, 12);
            rig.fault(&format!("kind = \"delayed-slides\", slide = {slide}, by = 2"))
        }),
        case("display late by a refresh", &["unsettled-display"], &["unsettled-display"], |rig, _| {
            rig.fault("kind = \"extra-latency\", refreshes = 1")
        }),
        case("display late by two refreshes", &["stale-frame"], &["stale-frame"], |rig, _| {
            rig.fault("kind = \"extra-latency\", refreshes = 2")
        }),
        case("cold panel", &["unsettled-display"], &["unsettled-display"], |rig, random| {
            let ms = random.between(20.0, 60.0);
            rig.fault(&format!("kind = \"slow-lcd\", lcd_10_90_ms = {ms}"))
        }),
        case("trigger too early", &["unsettled-display"], &["unsettled-display"], |rig, random| {
            rig.set("sim.projector.states_timing", false)
                .set("projector.trigger_delay_ms", random.between(36.0, 38.0))
        }),
    ]
}

fn light() -> Vec<Case> {
    vec![
        case("lamp flickers by 3 %", &["flicker"], &["flicker"], |rig, random| {
            flickering(rig, 0.03, mains(random))
        }),
        case("lamp flickers by 10 %", &["flicker"], &["flicker"], |rig, random| {
            flickering(rig, 0.1, mains(random))
        }),
        case("lamp flickers by 10 %, slowly", &["flicker"], &["flicker"], |rig, random| {
            flickering(rig, 0.1, random.between(0.7, 7.0))
        }),
        case(
            "lamp flickers by 5 %, within half a period",
            &["flicker", "exposure-drift"],
            &["flicker", "exposure-drift"],
            |rig, random| flickering(rig, 0.05, random.between(0.15, 0.3)),
        ),
        case("lamp dips once", &["flicker"], &["flicker"], |rig, random| {
            let at_ms = random.between(300.0, 2000.0);
            rig.fault(&format!("kind = \"lamp-burst\", at_ms = {at_ms}, for_ms = 90.0, share = -0.2"))
        }),
        case("lamp warms up", &["exposure-drift"], &["exposure-drift"], |rig, random| {
            let share = random.between(0.04, 0.15);
            rig.fault(&format!("kind = \"lamp-drift\", share = {share}, over_ms = 4000.0"))
        }),
        case("automatic exposure", &["exposure-drift"], &["exposure-drift"], |rig, random| {
            let (target, speed) = (random.between(0.2, 0.4), random.between(0.05, 0.5));
            rig.fault(&format!("kind = \"auto-exposure\", target = {target}, speed = {speed}"))
        }),
        case("room light switched on", &["ambient-drift"], &["ambient-drift"], |rig, random| {
            let (at_ms, e) = (random.between(400.0, 2400.0), random.between(150.0, 600.0));
            rig.fault(&format!("kind = \"ambient-change\", at_ms = {at_ms}, electrons = {e}"))
        }),
        case("daylight comes", &["ambient-drift"], &["ambient-drift"], |rig, random| {
            let e = random.between(200.0, 800.0);
            rig.fault(&format!("kind = \"ambient-change\", at_ms = 0.0, over_ms = 3000.0, electrons = {e}"))
        }),
        case("gamma 2.2", &["nonlinear-response"], &["nonlinear-response"], |rig, _| {
            rig.fault("kind = \"hidden-gamma\", exponent = 2.2")
        }),
        case("gamma 1/2.2", &["nonlinear-response"], &["nonlinear-response"], |rig, _| {
            rig.fault("kind = \"hidden-gamma\", exponent = 0.4545")
        }),
        case("too much light", &["saturated"], &["saturated"], |rig, random| {
            rig.set("camera.exposure_us", random.between(4000.0, 12000.0))
        }),
        case("empty scene", &["nothing-lit"], &["nothing-lit"], |rig, _| {
            rig.set("sim.scene", "scenes/empty.toml")
        }),
        case("exposure loses the dark plate", &["low-coverage"], &["low-coverage"], |rig, random| {
            rig.set("camera.exposure_us", random.between(20.0, 60.0))
        }),
    ]
}

fn optics() -> Vec<Case> {
    vec![
        case("camera bumped", &["motion"], &["motion"], |rig, random| {
            let (at_ms, degrees) = (random.between(300.0, 2200.0), random.between(0.1, 0.6));
            rig.fault(&format!("kind = \"bumped-camera\", at_ms = {at_ms}, turn_deg = [0.0, {degrees}, 0.0]"))
        }),
        case("object bumped", &["motion"], &["motion"], |rig, random| {
            let (at_ms, mm) = (random.between(300.0, 2200.0), random.between(1.5, 8.0));
            rig.fault(&format!(
                "kind = \"bumped-object\", at_ms = {at_ms}, object = \"black\", by_mm = [{mm}, 0.0, 0.0]"
            ))
        }),
        case(
            "polarizer turned by 15 to 35 degrees",
            &["polarization-weak"],
            &["polarization-weak"],
            |rig, random| turned(rig, random.between(15.0, 35.0)),
        ),
        case(
            "polarizer turned by 60 to 90 degrees",
            &["polarization-inverted"],
            &["polarization-inverted"],
            |rig, random| turned(rig, random.between(60.0, 90.0)),
        ),
        case("channels exchanged", &["polarization-inverted"], &["polarization-inverted"], |rig, _| {
            rig.set("projector.horizontal", "rb").set("projector.vertical", "g")
        }),
        case("plaster", &["ok", "polarization-weak"], &["ok", "polarization-weak"], |rig, _| {
            rig.set("sim.scene", "scenes/sphere-on-plaster.toml")
        }),
    ]
}

fn modes() -> Vec<Case> {
    let in_mode = |mode, case: Case| Case { mode: Some(mode), ..case };
    vec![
        in_mode("paper", case("paper: nothing wrong", &["ok"], &["ok"], |rig, _| rig)),
        in_mode(
            "paper",
            case(
                "paper: channels exchanged",
                &["polarization-inverted"],
                &["polarization-inverted"],
                |rig, _| rig.set("projector.horizontal", "rb").set("projector.vertical", "g"),
            ),
        ),
        in_mode(
            "paper",
            case("paper: stale frame", &["stale-frame"], &["stale-frame"], |rig, random| {
                rig.fault(&at_frame("stale-frame", "", random))
            }),
        ),
        in_mode("fast", case("fast: nothing wrong", &["ok"], &["ok"], |rig, _| rig)),
        in_mode(
            "fast",
            case("fast: P and Q exchanged", &["swapped-frames"], &["swapped-frames"], |rig, random| {
                let slide = 2 + 2 * random.whole(0, 7);
                rig.fault(&format!("kind = \"exchanged-slides\", slide = {slide}"))
            }),
        ),
        in_mode("gray", case("gray: nothing wrong", &["ok"], &["ok"], |rig, _| rig)),
        in_mode(
            "gray",
            case("gray: torn frame", &["torn-frame"], &["torn-frame"], |rig, random| {
                let row = random.row();
                rig.fault(&at_frame("torn-frame", &format!(", row = {row}"), random))
            }),
        ),
    ]
}
