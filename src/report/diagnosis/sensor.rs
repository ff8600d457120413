//! Pixels and lines of the sensor that do not answer to light.

use serde_json::json;

use super::{Diagnosis, Reason, rules::plural};
use crate::{
    decode::{Class, Decoded},
    report::PixelCounts,
};

/// Dead pixels among the valid ones: sensors as sold have fewer.
const DEAD: f64 = 1e-4;
const LEAST_DEAD: u64 = 10;
/// Modulation of the neighbours, in sigma, beside which a pixel without any is dead.
const STRONG_SIGMA: f64 = 12.0;
/// A line of the sensor counts where it crosses this many pixels with valid neighbours, and is dead where it fails on
/// most of them.
const LINE_PIXELS: u32 = 50;
const LINE_DEAD: f64 = 0.9;

/// Pixels that stay dark amid valid ones, and lines of them.
pub fn defect(decoded: &Decoded, pixels: &PixelCounts) -> Option<Reason> {
    let class = &decoded.class;
    let (width, height) = (class.width(), class.height());
    let valid = |x: usize, y: usize| class.at(x, y).is_valid();
    // Where the light is weak, noise alone puts out single pixels.
    let strong = |x: usize, y: usize| {
        let modulation = f64::from(decoded.modulation.at(x, y)).abs();
        let sigma = (decoded.noise.variance(modulation) + decoded.noise.variance(0.0)).sqrt();
        modulation > STRONG_SIGMA * sigma
    };
    let mut dead = 0u64;
    // Crossed and dead pixels of each column and row of the sensor.
    let (mut columns, mut rows) = (vec![[0u32; 2]; width], vec![[0u32; 2]; height]);
    for (y, row) in rows.iter_mut().enumerate().take(height.saturating_sub(1)).skip(1) {
        for (x, column) in columns.iter_mut().enumerate().take(width.saturating_sub(1)).skip(1) {
            let class_here = class.at(x, y);
            // Rejected for its word is not dead: along stripes, whole columns may be.
            let failed = u32::from(matches!(class_here, Class::Unlit | Class::Saturated));
            let (beside, above) = (valid(x - 1, y) && valid(x + 1, y), valid(x, y - 1) && valid(x, y + 1));
            if beside {
                column[0] += 1;
                column[1] += failed;
            }
            if above {
                row[0] += 1;
                row[1] += failed;
            }
            let corners =
                || valid(x - 1, y - 1) && valid(x + 1, y - 1) && valid(x - 1, y + 1) && valid(x + 1, y + 1);
            let is_bright = || strong(x - 1, y) && strong(x + 1, y) && strong(x, y - 1) && strong(x, y + 1);
            dead += u64::from(class_here == Class::Unlit && beside && above && corners() && is_bright());
        }
    }
    let lines = |counts: &[[u32; 2]]| {
        let is_dead = |[crossed, failed]: &[u32; 2]| {
            *crossed >= LINE_PIXELS && f64::from(*failed) > LINE_DEAD * f64::from(*crossed)
        };
        counts.iter().enumerate().filter(|(_, count)| is_dead(count)).map(|(at, _)| at).collect::<Vec<_>>()
    };
    let (columns, rows) = (lines(&columns), lines(&rows));
    let many = dead >= LEAST_DEAD && dead as f64 > DEAD * pixels.valid as f64;
    if !many && columns.is_empty() && rows.is_empty() {
        return None;
    }
    Some(Reason::degraded(
        Diagnosis::SensorDefect,
        format!(
            "{} amid good ones, {} and {} of the sensor do not answer to light; clean the sensor's window, and \
             check the camera with `polscan show white`; the pixels are left out",
            plural(dead, "single pixel"),
            plural(columns.len() as u64, "column"),
            plural(rows.len() as u64, "row"),
        ),
        json!({ "pixels": dead, "columns": columns, "rows": rows }),
    ))
}
