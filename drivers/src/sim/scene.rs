//! Scene files: objects of simple shapes, their materials and levels. The file format is the twin's own.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::{
    faults::Faults,
    print::Print,
    surface::{Clip, Primitive, Shape as Solid},
};

/// A scene in the camera's frame (mm; x right, y down, z forward).
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// Materials by name.
    #[serde(default)]
    pub materials: BTreeMap<String, Material>,
    /// Objects, in the order of the truth's object numbers. A shape of several faces takes several numbers.
    #[serde(default)]
    pub objects: Vec<Object>,
}

/// What a surface does to light: a microfacet lobe (GGX) that reflects by Fresnel's laws and so keeps what they keep of
/// the polarization, plus a Lambertian part that depolarises.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Material {
    /// Complex refractive index [n, k] of the lobe's facets; k = 0 is a dielectric. Absent: no lobe.
    pub index: Option<[f64; 2]>,
    /// Width (alpha) of the lobe.
    #[serde(default = "satin")]
    pub roughness: f64,
    /// Albedo of the depolarising part.
    #[serde(default)]
    pub diffuse: f64,
    /// Factor per projector channel on all of the above.
    #[serde(default = "untinted")]
    pub tint: [f64; 3],
    /// The reflectance varies by this share: from `1 - texture` to 1.
    #[serde(default)]
    pub texture: f64,
    /// Size of the texture's coarsest features.
    #[serde(default = "texture_size")]
    pub texture_mm: f64,
}

fn satin() -> f64 {
    0.3
}

fn untinted() -> [f64; 3] {
    [1.0; 3]
}

fn texture_size() -> f64 {
    6.0
}

/// One object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Object {
    /// Name in reports, unique in the scene.
    pub name: String,
    /// Name of its material.
    pub material: String,
    /// Light of its brightest lit pixel under uniform H: a share of the full well at the camera's reference exposure,
    /// or of the level of `level_of`. Absent: whatever its material returns in the light that the first object with a
    /// level needs for it.
    pub level: Option<f64>,
    /// Name of an object with a level of its own that `level` refers to.
    pub level_of: Option<String>,
    /// What is printed on it; only on a plane.
    pub print: Option<Print>,
    /// Shape and place.
    pub shape: Shape,
}

/// Shape of an object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Shape {
    /// A plane.
    Plane(Plane),
    /// A sphere.
    Sphere(Sphere),
    /// Two parallel planes and the riser between them: three faces NAME-left, NAME-right, NAME-riser.
    Step(Step),
    /// Two planes that meet in a vertical line: faces NAME-left, NAME-right.
    VGroove(VGroove),
    /// Vertical strips of one plane, NAME-00, NAME-01, ..., of falling reflectance.
    Wedge(Wedge),
}

/// A bounded plane.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plane {
    /// A point of the plane.
    pub point_mm: [f64; 3],
    /// Normal, of any length, on either side.
    pub normal: [f64; 3],
    /// Extent along x; unbounded by default.
    pub x_mm: Option<[f64; 2]>,
    /// Extent along y; unbounded by default.
    pub y_mm: Option<[f64; 2]>,
}

/// A sphere.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sphere {
    /// Centre.
    pub centre_mm: [f64; 3],
    /// Radius.
    pub radius_mm: f64,
}

/// A step that faces the camera, its edge vertical.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Where the edge lies.
    pub edge_x_mm: f64,
    /// z of the plane left of the edge.
    pub left_z_mm: f64,
    /// z of the plane right of the edge.
    pub right_z_mm: f64,
    /// Extent along x.
    pub x_mm: [f64; 2],
    /// Extent along y.
    pub y_mm: [f64; 2],
}

/// A groove that opens towards the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VGroove {
    /// A point of its bottom line, which is vertical.
    pub bottom_mm: [f64; 3],
    /// Angle between its faces.
    pub opening_deg: f64,
    /// Depth from rim to bottom.
    pub depth_mm: f64,
    /// Extent along y.
    pub y_mm: [f64; 2],
}

/// Strips of falling reflectance on one plane.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wedge {
    /// A point of the plane.
    pub point_mm: [f64; 3],
    /// Normal, of any length, on either side.
    pub normal: [f64; 3],
    /// Extent along x; strips divide it evenly.
    pub x_mm: [f64; 2],
    /// Extent along y.
    pub y_mm: [f64; 2],
    /// Number of strips.
    pub strips: u32,
    /// The last strip reflects `10^-decades` of the first.
    pub decades: f64,
}

/// Objects that a truth map can number.
const MOST_PRIMITIVES: usize = 255;

impl Scene {
    /// Every fault, each with its key path. Empty where the scene can be built.
    pub fn validate(&self) -> Vec<String> {
        let mut faults = Faults::new("");
        for (name, material) in &self.materials {
            material.validate(&mut faults, &format!("materials.{name}"));
        }
        for (number, object) in self.objects.iter().enumerate() {
            self.validate_object(&mut faults, number, object);
        }
        if !self.objects.is_empty()
            && !self.objects.iter().any(|object| object.level.is_some() && object.level_of.is_none())
        {
            faults
                .add("objects", "need at least one with a level of its own, to set the projector's light by");
        }
        let primitives: usize = self.objects.iter().map(|object| object.shape.faces()).sum();
        if primitives > MOST_PRIMITIVES {
            faults.add(
                "objects",
                &format!("have {primitives} faces, at most {MOST_PRIMITIVES} can be numbered"),
            );
        }
        faults.into_list()
    }

    fn validate_object(&self, faults: &mut Faults, number: usize, object: &Object) {
        let key = format!("objects[{number}]");
        if object.name.is_empty() {
            faults.add(&format!("{key}.name"), "is empty");
        }
        if self.objects[..number].iter().any(|other| other.name == object.name) {
            faults.add(&format!("{key}.name"), &format!("`{}` is taken by an earlier object", object.name));
        }
        if !self.materials.contains_key(&object.material) {
            faults.add(&format!("{key}.material"), &format!("no material is called `{}`", object.material));
        }
        if let Some(level) = object.level {
            faults.above(&format!("{key}.level"), level, 0.0);
        }
        if let Some(reference) = &object.level_of {
            let known = self.objects.iter().any(|other| {
                other.name == *reference
                    && other.name != object.name
                    && other.level.is_some()
                    && other.level_of.is_none()
            });
            if !known {
                let problem = format!("no other object `{reference}` has a level of its own");
                faults.add(&format!("{key}.level_of"), &problem);
            }
            if object.level.is_none() {
                faults.add(&format!("{key}.level"), "is missing beside level_of");
            }
        }
        if let Some(print) = &object.print {
            print.validate(faults, &format!("{key}.print"));
            if !matches!(object.shape, Shape::Plane(_)) {
                faults.add(&format!("{key}.print"), "is on no plane");
            }
        }
        object.shape.validate(faults, &format!("{key}.shape"));
    }

    /// Faces of all objects, with the number of their object.
    pub(crate) fn primitives(&self) -> Vec<Primitive> {
        let mut primitives = Vec::new();
        for (object, description) in self.objects.iter().enumerate() {
            for (suffix, shape, reflectance) in description.shape.solids() {
                primitives.push(Primitive {
                    name: format!("{}{suffix}", description.name),
                    object,
                    shape,
                    reflectance,
                    shifted: Vector3::zeros(),
                });
            }
        }
        primitives
    }
}

impl Material {
    fn validate(&self, faults: &mut Faults, key: &str) {
        if let Some([n, k]) = self.index {
            faults.above(&format!("{key}.index[0]"), n, 0.0);
            faults.at_least(&format!("{key}.index[1]"), k, 0.0);
        } else if self.diffuse == 0.0 {
            faults.add(key, "reflects nothing: give it an index or a diffuse part");
        }
        faults.within(&format!("{key}.roughness"), self.roughness, 0.01, 1.0);
        faults.within(&format!("{key}.diffuse"), self.diffuse, 0.0, 1.0);
        for (channel, &tint) in self.tint.iter().enumerate() {
            faults.at_least(&format!("{key}.tint[{channel}]"), tint, 0.0);
        }
        faults.within(&format!("{key}.texture"), self.texture, 0.0, 1.0);
        faults.above(&format!("{key}.texture_mm"), self.texture_mm, 0.0);
    }
}

/// `[low, high]` with low < high.
fn validate_extent(faults: &mut Faults, key: &str, [low, high]: [f64; 2]) {
    if !(low.is_finite() && high.is_finite() && low < high) {
        faults.add(key, &format!("is [{low}, {high}], must be two finite numbers that rise"));
    }
}

fn validate_point(faults: &mut Faults, key: &str, point: [f64; 3]) {
    if point.iter().any(|value| !value.is_finite()) {
        faults.add(key, &format!("is {point:?}, must be finite"));
    }
}

fn validate_normal(faults: &mut Faults, key: &str, normal: [f64; 3]) {
    let length = Vector3::from(normal).norm();
    if !(length.is_finite() && length > 1e-9) {
        faults.add(key, &format!("is {normal:?}, must be finite and not zero"));
    }
}

impl Shape {
    fn faces(&self) -> usize {
        match self {
            Self::Plane(_) | Self::Sphere(_) => 1,
            Self::Step(_) => 3,
            Self::VGroove(_) => 2,
            Self::Wedge(wedge) => wedge.strips as usize,
        }
    }

    fn validate(&self, faults: &mut Faults, key: &str) {
        match self {
            Self::Plane(plane) => {
                let key = format!("{key}.plane");
                validate_point(faults, &format!("{key}.point_mm"), plane.point_mm);
                validate_normal(faults, &format!("{key}.normal"), plane.normal);
                for (name, extent) in [("x_mm", plane.x_mm), ("y_mm", plane.y_mm)] {
                    if let Some(extent) = extent {
                        validate_extent(faults, &format!("{key}.{name}"), extent);
                    }
                }
            }
            Self::Sphere(sphere) => {
                validate_point(faults, &format!("{key}.sphere.centre_mm"), sphere.centre_mm);
                faults.above(&format!("{key}.sphere.radius_mm"), sphere.radius_mm, 0.0);
            }
            Self::Step(step) => {
                let key = format!("{key}.step");
                validate_extent(faults, &format!("{key}.x_mm"), step.x_mm);
                validate_extent(faults, &format!("{key}.y_mm"), step.y_mm);
                faults.within(&format!("{key}.edge_x_mm"), step.edge_x_mm, step.x_mm[0], step.x_mm[1]);
                faults.above(&format!("{key}.left_z_mm"), step.left_z_mm, 0.0);
                faults.above(&format!("{key}.right_z_mm"), step.right_z_mm, 0.0);
                if step.left_z_mm == step.right_z_mm {
                    faults.add(&format!("{key}.right_z_mm"), "equals left_z_mm: that is a plane");
                }
            }
            Self::VGroove(groove) => {
                let key = format!("{key}.v-groove");
                validate_point(faults, &format!("{key}.bottom_mm"), groove.bottom_mm);
                faults.within(&format!("{key}.opening_deg"), groove.opening_deg, 1.0, 179.0);
                faults.above(&format!("{key}.depth_mm"), groove.depth_mm, 0.0);
                validate_extent(faults, &format!("{key}.y_mm"), groove.y_mm);
            }
            Self::Wedge(wedge) => {
                let key = format!("{key}.wedge");
                validate_point(faults, &format!("{key}.point_mm"), wedge.point_mm);
                validate_normal(faults, &format!("{key}.normal"), wedge.normal);
                validate_extent(faults, &format!("{key}.x_mm"), wedge.x_mm);
                validate_extent(faults, &format!("{key}.y_mm"), wedge.y_mm);
                if !(2..=100).contains(&wedge.strips) {
                    faults.add(
                        &format!("{key}.strips"),
                        &format!("is {}, must be within 2 and 100", wedge.strips),
                    );
                }
                faults.within(&format!("{key}.decades"), wedge.decades, 0.0, 10.0);
            }
        }
    }

    /// Faces as (suffix of the name, shape, reflectance).
    fn solids(&self) -> Vec<(String, Solid, f64)> {
        match self {
            Self::Plane(plane) => {
                let clip = Clip::new(plane.x_mm, plane.y_mm, None);
                vec![(String::new(), Solid::plane(plane.point_mm, plane.normal, clip), 1.0)]
            }
            Self::Sphere(sphere) => {
                let centre = Vector3::from(sphere.centre_mm);
                vec![(String::new(), Solid::Sphere { centre, radius: sphere.radius_mm }, 1.0)]
            }
            Self::Step(step) => step.solids(),
            Self::VGroove(groove) => groove.solids(),
            Self::Wedge(wedge) => wedge.solids(),
        }
    }
}

impl Step {
    fn solids(&self) -> Vec<(String, Solid, f64)> {
        let [left, right] = self.x_mm;
        let edge = self.edge_x_mm;
        let facing = [0.0, 0.0, -1.0];
        let rise = [self.left_z_mm.min(self.right_z_mm), self.left_z_mm.max(self.right_z_mm)];
        let face =
            |z, extent| Solid::plane([0.0, 0.0, z], facing, Clip::new(Some(extent), Some(self.y_mm), None));
        vec![
            ("-left".into(), face(self.left_z_mm, [left, edge]), 1.0),
            ("-right".into(), face(self.right_z_mm, [edge, right]), 1.0),
            (
                "-riser".into(),
                Solid::plane([edge, 0.0, 0.0], [1.0, 0.0, 0.0], Clip::new(None, Some(self.y_mm), Some(rise))),
                1.0,
            ),
        ]
    }
}

impl VGroove {
    fn solids(&self) -> Vec<(String, Solid, f64)> {
        let half = (0.5 * self.opening_deg).to_radians();
        let [x, _, z] = self.bottom_mm;
        let reach = self.depth_mm * half.tan();
        let depth = Some([z - self.depth_mm, z]);
        let face = |extent, side: f64| {
            let normal = [-side * half.cos(), 0.0, -half.sin()];
            Solid::plane(self.bottom_mm, normal, Clip::new(Some(extent), Some(self.y_mm), depth))
        };
        vec![
            ("-left".into(), face([x - reach, x], -1.0), 1.0),
            ("-right".into(), face([x, x + reach], 1.0), 1.0),
        ]
    }
}

impl Wedge {
    fn solids(&self) -> Vec<(String, Solid, f64)> {
        let [left, right] = self.x_mm;
        let width = (right - left) / f64::from(self.strips);
        (0..self.strips)
            .map(|strip| {
                let x = left + width * f64::from(strip);
                let exponent = -self.decades * f64::from(strip) / f64::from(self.strips - 1);
                let clip = Clip::new(Some([x, x + width]), Some(self.y_mm), None);
                (format!("-{strip:02}"), Solid::plane(self.point_mm, self.normal, clip), 10f64.powf(exponent))
            })
            .collect()
    }
}
