//! Which controls to set to which values for a linear response, and what differs afterwards.

use super::{Options, kernel::Control};
use crate::{camera::CameraSettings, error::Difference};

const GAMMA: u32 = 0x98_0910;
const AUTO_WHITE_BALANCE: u32 = 0x98_090c;
const AUTO_GAIN: u32 = 0x98_0912;
const GAIN: u32 = 0x98_0913;
const FLIP_X: u32 = 0x98_0914;
const FLIP_Y: u32 = 0x98_0915;
const POWER_LINE: u32 = 0x98_0918;
const SHARPNESS: u32 = 0x98_091b;
const BACKLIGHT: u32 = 0x98_091c;
const BRIGHTNESS: u32 = 0x98_0900;
const AUTO_EXPOSURE: u32 = 0x9a_0901;
const EXPOSURE: u32 = 0x9a_0902;
const EXPOSURE_PRIORITY: u32 = 0x9a_0903;
const AUTO_FOCUS: u32 = 0x9a_090c;

/// `V4L2_EXPOSURE_MANUAL`
const MANUAL: i32 = 1;

/// Value of the exposure control for one microsecond.
const EXPOSURE_UNIT_US: f64 = 100.0;

/// Value of the gamma control for a gamma of 1, by the convention of USB cameras.
const GAMMA_UNIT: f64 = 100.0;

/// What must be off, in this order and before what it would change: control, value, setting.
const OFF: [(u32, i32, &str); 10] = [
    (AUTO_EXPOSURE, MANUAL, "exposure_auto"),
    (EXPOSURE_PRIORITY, 0, "frame_rate"),
    (AUTO_GAIN, 0, "gain_auto"),
    (AUTO_WHITE_BALANCE, 0, "isp"),
    (BACKLIGHT, 0, "isp"),
    (POWER_LINE, 0, "isp"),
    (AUTO_FOCUS, 0, "isp"),
    (SHARPNESS, 0, "sharpening"),
    (FLIP_X, 0, "reverse_x"),
    (FLIP_Y, 0, "reverse_y"),
];

/// One value to set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Write {
    /// Control.
    pub id: u32,
    /// Value.
    pub value: i32,
    /// Setting that it stands for, as refusals name it.
    pub setting: &'static str,
}

/// Values to set, in order, and what no control can do.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Plan {
    /// Values.
    pub writes: Vec<Write>,
    /// Settings without a control, or out of its range.
    pub missing: Vec<Difference>,
}

fn difference(setting: &'static str, requested: String, offered: String) -> Difference {
    Difference { setting, requested, offered }
}

impl Plan {
    /// What `settings` ask of a camera with these controls.
    pub fn new(controls: &[Control], settings: &CameraSettings, options: &Options) -> Self {
        let mut plan = Self::default();
        let find = |id| controls.iter().find(|control| control.id == id);
        for (id, value, setting) in OFF {
            // What a camera does not have it does not do.
            if find(id).is_some() {
                plan.writes.push(Write { id, value, setting });
            }
        }
        plan.exposure(find(EXPOSURE), settings, options);
        let gain = options.gain_raw;
        match (find(GAIN), gain) {
            (Some(control), Some(raw)) => plan.value(control, raw, "gain_db", settings.gain_db),
            (Some(control), None) => plan.missing.push(difference(
                "gain_db",
                settings.gain_db.to_string(),
                format!(
                    "a gain of {} to {} in a unit of its own; set camera.gain_raw to the one that stands for it",
                    control.minimum, control.maximum
                ),
            )),
            (None, _) => plan.absent("gain_db", settings.gain_db),
        }
        match find(GAMMA) {
            Some(control) => plan.value(control, GAMMA_UNIT * settings.gamma, "gamma", settings.gamma),
            None => plan.absent("gamma", settings.gamma),
        }
        if let Some(level) = options.black_level {
            match find(BRIGHTNESS) {
                Some(control) => plan.value(control, level, "black_level", level),
                None => plan.absent("black_level", level),
            }
        }
        plan
    }

    fn exposure(&mut self, control: Option<&Control>, settings: &CameraSettings, options: &Options) {
        let asked = settings.exposure_us;
        match (control, options.fixed_exposure_us) {
            (Some(control), _) => self.value(control, asked / EXPOSURE_UNIT_US, "exposure_us", asked),
            (None, Some(fixed)) if fixed == asked => {}
            (None, Some(fixed)) => self.missing.push(difference(
                "exposure_us",
                asked.to_string(),
                format!("{fixed} by camera.fixed_exposure_us"),
            )),
            (None, None) => self.missing.push(difference(
                "exposure_us",
                asked.to_string(),
                "no control; set camera.fixed_exposure_us if it is set on the camera itself".to_owned(),
            )),
        }
    }

    fn absent(&mut self, setting: &'static str, asked: f64) {
        self.missing.push(difference(setting, asked.to_string(), "no control".to_owned()));
    }

    /// The nearest value of a control, or that it has none near enough.
    fn value(&mut self, control: &Control, wanted: f64, setting: &'static str, asked: f64) {
        let Control { id, minimum, maximum, step, .. } = *control;
        let step = f64::from(step.max(1));
        let steps = ((wanted - f64::from(minimum)) / step).round();
        let nearest = f64::from(minimum) + steps * step;
        let inside = (f64::from(minimum)..=f64::from(maximum)).contains(&nearest);
        if inside && (nearest - wanted).abs() <= 0.5 * step {
            self.writes.push(Write { id, value: nearest as i32, setting });
        } else {
            let offered = format!("{minimum} to {maximum} of its control, {wanted} would be needed");
            self.missing.push(difference(setting, asked.to_string(), offered));
        }
    }

    /// Sets everything, then reads everything back: one control may change another. What differs.
    pub fn carry_out(
        &self,
        set: impl Fn(u32, i32) -> std::io::Result<()>,
        get: impl Fn(u32) -> std::io::Result<i32>,
    ) -> std::io::Result<Vec<Difference>> {
        let mut differences = self.missing.clone();
        let mut taken = Vec::new();
        for write in &self.writes {
            match set(write.id, write.value) {
                Ok(()) => taken.push(write),
                // The camera is gone rather than unwilling.
                Err(error) if is_gone(&error) => return Err(error),
                // It may have the value all the same: a control that cannot be set is not wrong for that.
                Err(error) if get(write.id).ok() != Some(write.value) => {
                    differences.push(difference(
                        write.setting,
                        write.value.to_string(),
                        format!("a refusal ({error})"),
                    ));
                }
                Err(_) => {}
            }
        }
        for write in taken {
            let found = get(write.id)?;
            if found != write.value {
                differences.push(difference(write.setting, write.value.to_string(), found.to_string()));
            }
        }
        Ok(differences)
    }

    /// Exposure time that the camera has once everything was set.
    pub fn exposure_us(&self, asked: f64) -> f64 {
        let written = self.writes.iter().find(|write| write.id == EXPOSURE);
        written.map_or(asked, |write| f64::from(write.value) * EXPOSURE_UNIT_US)
    }
}

/// Whether the device itself went away (`ENODEV`, `ENXIO`).
pub fn is_gone(error: &std::io::Error) -> bool {
    matches!(error.raw_os_error(), Some(6 | 19))
}

#[cfg(test)]
mod tests {
    use std::{
        cell::RefCell,
        collections::BTreeMap,
        io::{Error, Result},
    };

    use proptest::prelude::*;

    use super::*;
    use crate::camera::{PixelFormat, TriggerSource};

    fn control(id: u32, minimum: i32, maximum: i32, step: i32) -> Control {
        Control { id, kind: 1, name: String::new(), minimum, maximum, step, flags: 0 }
    }

    fn settings(exposure_us: f64) -> CameraSettings {
        CameraSettings {
            exposure_us,
            gain_db: 0.0,
            gamma: 1.0,
            region: None,
            format: PixelFormat::Mono8,
            trigger: TriggerSource::Software,
        }
    }

    fn options() -> Options {
        Options { gain_raw: Some(16.0), ..Options::default() }
    }

    /// A webcam that does what its controls say.
    struct Webcam {
        values: RefCell<BTreeMap<u32, i32>>,
        log: RefCell<Vec<(u32, i32)>>,
        /// Control that snaps to a value of its own, and to which.
        stubborn: Option<(u32, i32)>,
    }

    impl Webcam {
        fn new(stubborn: Option<(u32, i32)>) -> Self {
            let values = [(AUTO_EXPOSURE, 3), (EXPOSURE, 156), (GAIN, 64), (GAMMA, 220), (AUTO_GAIN, 1)];
            Self { values: RefCell::new(values.into()), log: RefCell::default(), stubborn }
        }

        fn controls() -> Vec<Control> {
            let mut all = vec![
                control(EXPOSURE, 1, 5000, 1),
                control(GAIN, 0, 255, 1),
                control(GAMMA, 72, 500, 1),
                control(AUTO_GAIN, 0, 1, 1),
                control(AUTO_EXPOSURE, 0, 3, 1),
            ];
            all.sort_by_key(|control| control.id);
            all
        }

        fn set(&self, id: u32, value: i32) -> Result<()> {
            self.log.borrow_mut().push((id, value));
            // Exposure is locked while it is automatic, as the kernel's driver of USB cameras has it.
            if id == EXPOSURE && self.values.borrow()[&AUTO_EXPOSURE] != MANUAL {
                return Err(Error::from_raw_os_error(13));
            }
            let value =
                self.stubborn.filter(|stubborn| stubborn.0 == id).map_or(value, |stubborn| stubborn.1);
            self.values.borrow_mut().insert(id, value);
            Ok(())
        }

        fn carry_out(&self, settings: &CameraSettings, options: &Options) -> Result<Vec<Difference>> {
            let plan = Plan::new(&Self::controls(), settings, options);
            plan.carry_out(|id, value| self.set(id, value), |id| Ok(self.values.borrow()[&id]))
        }
    }

    #[test]
    fn exposure_is_manual_before_it_is_set_in_units_of_100_us() {
        let webcam = Webcam::new(None);
        assert_eq!(webcam.carry_out(&settings(2000.0), &options()).unwrap(), []);
        let log = webcam.log.borrow();
        assert_eq!(log.first(), Some(&(AUTO_EXPOSURE, 1)));
        assert!(log.contains(&(EXPOSURE, 20)) && log.contains(&(GAMMA, 100)) && log.contains(&(GAIN, 16)));
    }

    #[test]
    fn a_value_that_does_not_stick_is_a_difference() {
        for (stubborn, setting) in [
            ((EXPOSURE, 19), "exposure_us"),
            ((GAMMA, 110), "gamma"),
            ((GAIN, 17), "gain_db"),
            ((AUTO_GAIN, 1), "gain_auto"),
        ] {
            let differences = Webcam::new(Some(stubborn)).carry_out(&settings(2000.0), &options()).unwrap();
            let names: Vec<_> = differences.iter().map(|difference| difference.setting).collect();
            assert_eq!(names, [setting]);
        }
        // A camera that stays automatic takes no exposure either: both are told.
        let differences =
            Webcam::new(Some((AUTO_EXPOSURE, 3))).carry_out(&settings(2000.0), &options()).unwrap();
        let names: Vec<_> = differences.iter().map(|difference| difference.setting).collect();
        assert_eq!(names, ["exposure_us", "exposure_auto"]);
    }

    #[test]
    fn a_camera_that_goes_away_is_no_refusal() {
        let plan = Plan::new(&Webcam::controls(), &settings(2000.0), &options());
        let gone = plan.carry_out(|_, _| Err(Error::from_raw_os_error(19)), |_| Ok(0));
        assert!(is_gone(&gone.unwrap_err()));
    }

    #[test]
    fn what_has_no_control_is_named() {
        let plan = Plan::new(&[], &settings(2000.0), &Options::default());
        let names: Vec<_> = plan.missing.iter().map(|missing| missing.setting).collect();
        assert_eq!(names, ["exposure_us", "gain_db", "gamma"]);
        assert_eq!(plan.writes, []);
        let fixed = Options { fixed_exposure_us: Some(2000.0), ..Options::default() };
        let names = |plan: Plan| plan.missing.iter().map(|missing| missing.setting).collect::<Vec<_>>();
        assert_eq!(names(Plan::new(&[], &settings(2000.0), &fixed)), ["gain_db", "gamma"]);
        assert_eq!(names(Plan::new(&[], &settings(1000.0), &fixed)), ["exposure_us", "gain_db", "gamma"]);
    }

    proptest! {
        /// The oracle tries every value of the control.
        #[test]
        fn the_nearest_value_of_a_control_is_taken_or_none(
            minimum in -20i32..20, count in 0i32..40, step in 1i32..7, wanted in -30.0..300.0f64,
        ) {
            let control = control(GAIN, minimum, minimum + count * step, step);
            let mut plan = Plan::default();
            plan.value(&control, wanted, "gain_db", 0.0);
            let distance = |value: i32| (f64::from(value) - wanted).abs();
            let all = (0..=count).map(|n| minimum + n * step);
            let best = all.min_by(|&a, &b| distance(a).total_cmp(&distance(b))).unwrap();
            if distance(best) <= 0.5 * f64::from(step) {
                prop_assert_eq!(plan.writes.len(), 1);
                prop_assert_eq!(distance(plan.writes[0].value), distance(best));
            } else {
                prop_assert_eq!((plan.writes.len(), plan.missing.len()), (0, 1));
            }
        }
    }
}
