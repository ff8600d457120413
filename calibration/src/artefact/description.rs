//! What an artefact is, and what may be off about it.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// A rectangle of the camera's image: first column, first row, columns, rows in pixels.
pub type Region = [u32; 4];

/// A known artefact as it stands before the rig.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Artefact {
    /// Name, in the history.
    pub name: String,
    /// Flat surfaces.
    #[serde(default, rename = "plane", skip_serializing_if = "Vec::is_empty")]
    pub planes: Vec<Plane>,
    /// Heights between two of them.
    #[serde(default, rename = "step", skip_serializing_if = "Vec::is_empty")]
    pub steps: Vec<Step>,
    /// Balls.
    #[serde(default, rename = "ball", skip_serializing_if = "Vec::is_empty")]
    pub balls: Vec<Ball>,
    /// Distances between the centres of two of them.
    #[serde(default, rename = "distance", skip_serializing_if = "Vec::is_empty")]
    pub distances: Vec<Distance>,
}

/// A flat surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plane {
    /// Name.
    pub name: String,
    /// Where it is seen.
    pub region: Region,
    /// Most that it may seem bent: peak to peak of the quadratic that fits best, in mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bow_mm: Option<f64>,
    /// Most root mean square distance of its points from the plane, in mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rms_mm: Option<f64>,
}

/// A height between two parallel planes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Name.
    pub name: String,
    /// Plane that is closer to the camera.
    pub upper: String,
    /// Plane that is further away.
    pub lower: String,
    /// Height in mm.
    pub height_mm: f64,
    /// Most that the measured one may be off, in mm.
    pub tolerance_mm: f64,
}

/// A ball.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ball {
    /// Name.
    pub name: String,
    /// Where it is seen; what lies behind it may be in it as well.
    pub region: Region,
    /// Diameter in mm.
    pub diameter_mm: f64,
    /// Most that the measured one may be off, in mm.
    pub tolerance_mm: f64,
}

/// A distance between the centres of two balls.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distance {
    /// Name.
    pub name: String,
    /// The balls.
    pub between: [String; 2],
    /// Distance in mm.
    pub distance_mm: f64,
    /// Most that the measured one may be off, in mm.
    pub tolerance_mm: f64,
}

/// Everything that is wrong with a description.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("the artefact cannot be measured: {}", faults.join("; "))]
pub struct ArtefactError {
    /// A sentence for each fault, with its key path.
    pub faults: Vec<String>,
}

impl Artefact {
    /// Checks that there is something to measure, that all names are known and different, and all sizes above 0.
    ///
    /// # Errors
    /// All faults at once.
    pub fn check(&self) -> Result<(), ArtefactError> {
        let mut faults = Vec::new();
        if self.planes.is_empty() && self.balls.is_empty() {
            faults.push("there is no plane and no ball; add one".to_owned());
        }
        let names = self.planes.iter().map(|plane| &plane.name);
        let names = names.chain(self.steps.iter().map(|step| &step.name));
        let names = names.chain(self.balls.iter().map(|ball| &ball.name));
        let names: Vec<&String> = names.chain(self.distances.iter().map(|distance| &distance.name)).collect();
        for (index, name) in names.iter().enumerate() {
            if names[..index].contains(name) {
                faults.push(format!("`{name}` is there twice; give each part a name of its own"));
            }
        }
        let mut positive = |key: String, value: f64| {
            if !(value > 0.0 && value.is_finite()) {
                faults.push(format!("{key} is {value}; it must be above 0"));
            }
        };
        for plane in &self.planes {
            let key = |end: &str| format!("plane.{}.{end}", plane.name);
            plane.bow_mm.into_iter().for_each(|limit| positive(key("bow_mm"), limit));
            plane.rms_mm.into_iter().for_each(|limit| positive(key("rms_mm"), limit));
        }
        for ball in &self.balls {
            positive(format!("ball.{}.diameter_mm", ball.name), ball.diameter_mm);
            positive(format!("ball.{}.tolerance_mm", ball.name), ball.tolerance_mm);
        }
        for step in &self.steps {
            positive(format!("step.{}.height_mm", step.name), step.height_mm);
            positive(format!("step.{}.tolerance_mm", step.name), step.tolerance_mm);
        }
        for distance in &self.distances {
            positive(format!("distance.{}.distance_mm", distance.name), distance.distance_mm);
            positive(format!("distance.{}.tolerance_mm", distance.name), distance.tolerance_mm);
        }
        self.check_references(&mut faults);
        if faults.is_empty() { Ok(()) } else { Err(ArtefactError { faults }) }
    }

    fn check_references(&self, faults: &mut Vec<String>) {
        let regions = self.planes.iter().map(|plane| (&plane.name, plane.region));
        for (name, region) in regions.chain(self.balls.iter().map(|ball| (&ball.name, ball.region))) {
            if region[2] == 0 || region[3] == 0 {
                faults.push(format!("the region of `{name}` is empty; give columns and rows above 0"));
            }
        }
        for step in &self.steps {
            for plane in [&step.upper, &step.lower] {
                if !self.planes.iter().any(|known| known.name == *plane) {
                    faults.push(format!("step.{}: there is no plane `{plane}`", step.name));
                }
            }
            if step.upper == step.lower {
                faults.push(format!("step.{}: its planes are the same", step.name));
            }
        }
        for distance in &self.distances {
            for ball in &distance.between {
                if !self.balls.iter().any(|known| known.name == *ball) {
                    faults.push(format!("distance.{}: there is no ball `{ball}`", distance.name));
                }
            }
            if distance.between[0] == distance.between[1] {
                faults.push(format!("distance.{}: its balls are the same", distance.name));
            }
        }
        for plane in &self.planes {
            let in_step = self.steps.iter().any(|step| [&step.upper, &step.lower].contains(&&plane.name));
            if plane.bow_mm.is_none() && plane.rms_mm.is_none() && !in_step {
                faults.push(format!("plane.{}: nothing is asked of it; give bow_mm or rms_mm", plane.name));
            }
        }
    }
}
