//! The scene as the camera sees it, computed once: per pixel the projector coordinate and how strongly each channel of
//! the panel is seen there.

use nalgebra::{Complex, Matrix3, Vector3};
use rayon::prelude::*;

use super::{
    description::{PanelPolarization, RigDescription, middle_px},
    noise,
    optics::{Pinhole, Placement},
    panel::{Panel, reach_px},
    polarization::{Analyser, Ray, across},
    rig::RigError,
    scene::{Material, Scene},
    surface::{Primitive, is_shadowed, lobe, nearest, texture},
};

/// Number of no object.
pub(crate) const NO_OBJECT: u8 = 255;
/// Distance at which light fields are of order 1, in mm.
const UNIT_DISTANCE_MM: f64 = 1000.0;

/// What one pixel sees: what frames are rendered from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct View {
    /// Electrons at the reference exposure and full drive, per channel.
    pub(crate) gain: [f32; 3],
    /// [`Panel::position`] of the column and the row; meaningless without gain.
    pub(crate) column: u32,
    pub(crate) row: u32,
}

/// What one pixel sees: what nobody but the rig knows.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sight {
    /// Projector coordinate, NaN where the point is not lit by the picture.
    pub(crate) at: [f32; 2],
    /// z in mm, NaN where nothing is seen.
    pub(crate) depth_mm: f32,
    /// Number of the face.
    pub(crate) face: u8,
}

impl View {
    const DARK: Self = Self { gain: [0.0; 3], column: 0, row: 0 };
}

impl Sight {
    const NOTHING: Self = Self { at: [f32::NAN; 2], depth_mm: f32::NAN, face: NO_OBJECT };

    fn is_lit(&self) -> bool {
        self.at[0].is_finite()
    }
}

/// All views of a sensor with a border around it.
#[derive(Debug)]
pub(crate) struct World {
    /// Width with both borders.
    pub(crate) width: usize,
    /// Height with both borders.
    pub(crate) height: usize,
    /// Pixels around the sensor that blur into it.
    pub(crate) border: usize,
    /// Row-major.
    pub(crate) views: Vec<View>,
    /// Row-major.
    pub(crate) sights: Vec<Sight>,
    /// Names of the faces, and whether they are planar.
    pub(crate) faces: Vec<(String, bool)>,
}

/// Everything needed to look along a ray.
struct Tracer<'a> {
    camera: Pinhole,
    projector: Pinhole,
    placement: Placement,
    panel: &'a Panel,
    size: [f64; 2],
    analyser: Analyser,
    /// Projector's horizontal in the camera's frame.
    projector_horizontal: Vector3<f64>,
    /// Per channel: light at full drive and its degree of horizontal (negative: vertical) polarization.
    channels: [(f64, f64); 3],
    primitives: Vec<Primitive>,
    materials: Vec<&'a Material>,
    seed: u64,
}

/// The projector's lens.
pub(crate) fn projector_lens(description: &RigDescription) -> Pinhole {
    let projector = &description.projector;
    Pinhole::new(
        projector.focal_px,
        projector.centre_px(),
        [projector.k1, projector.k2, projector.p1, projector.p2, projector.k3],
    )
}

/// The camera's lens.
pub(crate) fn camera_lens(description: &RigDescription) -> Pinhole {
    let camera = &description.camera;
    Pinhole::new(camera.focal_px, camera.centre_px(), [camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
}

/// Where the projector stands.
pub(crate) fn placement(description: &RigDescription) -> Result<Placement, RigError> {
    let pose = &description.pose;
    if let (Some(rotation), Some(translation)) = (pose.rotation, pose.translation_mm) {
        let rotation = Matrix3::from_fn(|row, column| rotation[row][column]);
        return Ok(Placement::new(rotation, Vector3::from(translation)));
    }
    let (baseline, aim) = (pose.baseline_mm.unwrap_or(0.0), pose.aim_mm.unwrap_or(0.0));
    let middle = projector_lens(description)
        .ray(middle_px(description.projector.size))
        .ok_or(RigError::Lens { which: "projector" })?;
    Placement::aimed(Vector3::new(baseline, 0.0, 0.0), middle, Vector3::new(0.0, 0.0, aim))
        .ok_or(RigError::Aim)
}

impl World {
    /// Looks along the rays of all pixels and sets the levels of the scene's objects.
    pub(crate) fn new(description: &RigDescription, scene: &Scene, panel: &Panel) -> Result<Self, RigError> {
        let tracer = Tracer::new(description, scene, panel)?;
        let border = if description.camera.blur_px > 0.0 { reach_px(description.camera.blur_px) } else { 0 };
        let [width, height] = description.camera.size.map(|side| side as usize + 2 * border);
        let mut views = vec![View::DARK; width * height];
        let mut sights = vec![Sight::NOTHING; width * height];
        let rows = views.par_chunks_mut(width).zip(sights.par_chunks_mut(width));
        rows.enumerate().try_for_each(|(y, (views, sights))| {
            for (x, (view, sight)) in views.iter_mut().zip(sights).enumerate() {
                let pixel = [x as f64 - border as f64, y as f64 - border as f64];
                let ray = tracer.camera.ray(pixel).ok_or(RigError::Lens { which: "camera" })?;
                (*view, *sight) = tracer.look(ray);
            }
            Ok(())
        })?;
        let faces =
            tracer.primitives.iter().map(|face| (face.name.clone(), face.shape.is_planar())).collect();
        let mut world = Self { width, height, border, views, sights, faces };
        world.set_levels(description, scene, &tracer)?;
        Ok(world)
    }

    /// Scales the light of each object to its level: see [`super::scene::Object::level`].
    fn set_levels(
        &mut self,
        description: &RigDescription,
        scene: &Scene,
        tracer: &Tracer<'_>,
    ) -> Result<(), RigError> {
        let brightest = self.brightest(description, tracer, scene.objects.len());
        let full_well = description.camera.full_well_e;
        let mut factors: Vec<Option<f64>> = vec![None; scene.objects.len()];
        let mut light = None;
        for (number, object) in scene.objects.iter().enumerate() {
            let Some(share) = object.level else { continue };
            let base = match &object.level_of {
                None => full_well,
                Some(name) => {
                    let reference = scene.objects.iter().find(|other| other.name == *name);
                    full_well * reference.and_then(|other| other.level).unwrap_or(1.0)
                }
            };
            if brightest[number] <= 0.0 {
                return Err(RigError::Dark { object: object.name.clone() });
            }
            let factor = share * base / brightest[number];
            factors[number] = Some(factor);
            if object.level_of.is_none() && light.is_none() {
                light = Some(factor);
            }
        }
        let light = light.unwrap_or(1.0);
        let per_face: Vec<f32> =
            tracer.primitives.iter().map(|face| (factors[face.object].unwrap_or(light)) as f32).collect();
        self.views.par_iter_mut().zip(&self.sights).for_each(|(view, sight)| {
            if let Some(factor) = per_face.get(usize::from(sight.face)) {
                view.gain.iter_mut().for_each(|gain| *gain *= factor);
            }
        });
        Ok(())
    }

    /// Most light of any lit pixel of each object under uniform H, within the sensor.
    fn brightest(&self, description: &RigDescription, tracer: &Tracer<'_>, objects: usize) -> Vec<f64> {
        let polarization = description.projector.polarization;
        let carries_h = polarization.contains(&PanelPolarization::Horizontal);
        let drive: [f64; 3] = std::array::from_fn(|channel| {
            let on = !carries_h || polarization[channel] == PanelPolarization::Horizontal;
            tracer.panel.light(if on { 255 } else { 0 })
        });
        let rows = self.border..self.height - self.border;
        rows.into_par_iter()
            .map(|y| {
                let mut brightest = vec![0.0f64; objects];
                let row = y * self.width + self.border..(y + 1) * self.width - self.border;
                for (view, sight) in self.views[row.clone()].iter().zip(&self.sights[row]) {
                    if sight.is_lit() {
                        let object = tracer.primitives[usize::from(sight.face)].object;
                        let seen: f64 =
                            drive.iter().zip(view.gain).map(|(drive, gain)| drive * f64::from(gain)).sum();
                        brightest[object] = brightest[object].max(seen);
                    }
                }
                brightest
            })
            .reduce(|| vec![0.0; objects], |a, b| a.iter().zip(b).map(|(a, b)| a.max(b)).collect())
    }
}

impl<'a> Tracer<'a> {
    fn new(description: &RigDescription, scene: &'a Scene, panel: &'a Panel) -> Result<Self, RigError> {
        let projector = &description.projector;
        let placement = placement(description)?;
        let analyser = description.analyser.as_ref().map_or(Analyser::NONE, |analyser| {
            Analyser::linear(analyser.azimuth_error_deg.to_radians(), analyser.extinction)
        });
        let channels = std::array::from_fn(|channel| {
            let degree = (projector.extinction[channel] - 1.0) / (projector.extinction[channel] + 1.0);
            let signed = match projector.polarization[channel] {
                PanelPolarization::Horizontal => degree,
                PanelPolarization::Vertical => -degree,
                PanelPolarization::None => 0.0,
            };
            (projector.response[channel], signed)
        });
        let materials = scene.objects.iter().map(|object| &scene.materials[&object.material]).collect();
        Ok(Self {
            camera: camera_lens(description),
            projector: projector_lens(description),
            projector_horizontal: placement.rotation.transpose() * Vector3::x(),
            placement,
            panel,
            size: projector.size.map(f64::from),
            analyser,
            channels,
            primitives: scene.primitives(),
            materials,
            seed: description.seed,
        })
    }

    /// What is seen along a ray of the camera.
    fn look(&self, ray: Vector3<f64>) -> (View, Sight) {
        let Some((face, distance)) = nearest(&self.primitives, Vector3::zeros(), ray) else {
            return (View::DARK, Sight::NOTHING);
        };
        let point = ray * distance;
        let dark = (View::DARK, Sight { depth_mm: point.z as f32, face: face as u8, ..Sight::NOTHING });
        let primitive = &self.primitives[face];
        let normal = primitive.shape.normal_against(point, ray);
        let to_light = (self.placement.centre_mm - point).normalize();
        if normal.dot(&to_light) <= 0.0 {
            return dark;
        }
        let in_projector = self.placement.transform(point);
        let Some(at) = self.projector.project(in_projector) else { return dark };
        let coverage: [f64; 3] = std::array::from_fn(|channel| self.panel.coverage(channel, at));
        if coverage.iter().all(|&share| share < 1e-9)
            || is_shadowed(&self.primitives, point, normal, self.placement.centre_mm)
        {
            return dark;
        }
        // Each pixel of the panel sends the same flux, so that a screen parallel to the panel is evenly lit.
        let irradiance = UNIT_DISTANCE_MM * UNIT_DISTANCE_MM
            / (in_projector.normalize().z * in_projector.z * in_projector.z);
        let material = self.materials[primitive.object];
        let natural_and_polarized = self.reflect(material, normal, to_light, -ray);
        let grain = 1.0 - material.texture * self.texture(material, primitive, point);
        let strength = irradiance * primitive.reflectance * grain;
        let gain = std::array::from_fn(|channel| {
            let (light, degree) = self.channels[channel];
            let seen = natural_and_polarized[0] + degree * natural_and_polarized[1];
            (strength * light * material.tint[channel] * coverage[channel] * seen) as f32
        });
        let within = (0..2).all(|axis| at[axis] >= -0.5 && at[axis] < self.size[axis] - 0.5);
        let [column, row] = [0, 1].map(|axis| self.panel.position(axis, at[axis]));
        let at = if within { at.map(|value| value as f32) } else { [f32::NAN; 2] };
        (View { gain, column, row }, Sight { at, ..dark.1 })
    }

    fn texture(&self, material: &Material, primitive: &Primitive, point: Vector3<f64>) -> f64 {
        if material.texture == 0.0 {
            return 0.0;
        }
        texture(noise::mix(self.seed ^ noise::mix(primitive.object as u64)), point, material.texture_mm)
    }

    /// Light behind the analyser, per irradiance across the light, of a source with Stokes vector (1, 0, 0, 0), and what
    /// each unit of S1 adds to it.
    fn reflect(
        &self,
        material: &Material,
        normal: Vector3<f64>,
        to_light: Vector3<f64>,
        to_camera: Vector3<f64>,
    ) -> [f64; 2] {
        let scattered = material.diffuse / std::f64::consts::PI * normal.dot(&to_light);
        let mut seen = [scattered * self.analyser.intensity([1.0, 0.0, 0.0, 0.0]), 0.0];
        if let Some([n, k]) = material.index {
            let strength = lobe(material.roughness, normal, to_light, to_camera);
            let facet = (to_light + to_camera).normalize();
            for (seen, stokes) in seen.iter_mut().zip([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]) {
                let along = -to_light;
                let ray = Ray { along, first: across(self.projector_horizontal, along), stokes };
                let reflected = ray.reflect(facet, to_camera, Complex::new(n, k));
                *seen += strength * reflected.through(self.analyser, Vector3::x());
            }
        }
        seen
    }
}
