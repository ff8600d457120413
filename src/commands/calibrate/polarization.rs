//! `polscan calibrate polarization`.

use std::path::{Path, PathBuf};

use polscan_calibration::polarization::Turning;

use super::output::{Place, print, with_rig};
use crate::{
    calibrate::{
        Output,
        polarization::{Task, read_set, run as calibrate, turning_advice},
    },
    config::Settings,
    engine::Failure,
    measure::polarization::watch,
    report::NamedRegion,
    sequencer::CancelFlag,
};

/// Arguments of `polscan calibrate polarization`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    place: Place,
    /// What the polarizer's mount reads now, in degrees counter-clockwise as the camera sees it; 0 is where H should pass.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true, default_value_t = 0.0)]
    angle: f64,
    /// Folder of an earlier run at another angle; repeat it for each. Three angles make a calibration.
    #[arg(long, value_name = "DIR")]
    with: Vec<PathBuf>,
    /// Bare metal in the camera's image; what is evenly lit where this is left out.
    #[arg(long, value_name = "NAME=X,Y,W,H")]
    coupon: Option<NamedRegion>,
    /// A white card in the camera's image, to find the drive levels at which it returns H and V alike.
    #[arg(long, value_name = "NAME=X,Y,W,H")]
    card: Option<NamedRegion>,
    /// Print H, V and how far the polarizer stands from the best position seen, until interrupted, before measuring.
    #[arg(long)]
    watch: bool,
    /// End --watch after so many values.
    #[arg(long, value_name = "N", requires = "watch")]
    values: Option<u64>,
}

impl Args {
    /// Configuration file that they name.
    pub fn config(&self) -> Option<&Path> {
        self.place.config.as_deref()
    }
}

/// Measures one angle, joins it with those of earlier runs, and writes; returns the exit code.
pub fn run(args: &Args, settings: &Settings, json: bool) -> Result<u8, Failure> {
    let earlier = args.with.iter().map(|folder| read_set(folder)).collect::<Result<_, Failure>>()?;
    let output = Output::create(&args.place.out)?;
    let task = Task { angle_deg: args.angle, earlier, coupon: args.coupon.clone(), card: args.card.clone() };
    let outcome = with_rig(settings, |rig, cancel, progress| {
        if !args.watch {
            return calibrate(output, rig, settings, &task, cancel, progress);
        }
        follow(args.values, |seen| watch(rig, settings, task.coupon.as_ref(), cancel, seen))?;
        // The interrupt ended the watch; a second one ends the program.
        calibrate(output, rig, settings, &task, &CancelFlag::default(), progress)
    })?;
    Ok(print(&args.place.out, &outcome, json))
}

/// Prints each value of a watch, and how far off the polarizer stands.
fn follow(
    values: Option<u64>,
    watch: impl FnOnce(&mut dyn FnMut(f64, f64) -> bool) -> Result<(), Failure>,
) -> Result<(), Failure> {
    let mut turning = Turning::default();
    let mut count = 0;
    watch(&mut |h, v| {
        count += 1;
        let advice = turning_advice(turning.add(v));
        // Values of a watch are for eyes: stdout stays one object for scripts.
        eprintln!("H {h:8.1} DN  V {v:8.1} DN  H/V {:7.2}  {advice}", h / v.max(1e-9));
        values.is_none_or(|values| count < values)
    })
}
