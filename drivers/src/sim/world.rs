//! The scene as the camera sees it, computed once: per pixel the projector coordinate and how strongly each channel of
//! the panel is seen there.

use nalgebra::{Complex, Matrix3, Rotation3, Vector3};
use rayon::prelude::*;

use super::{
    description::{PanelPolarization, RigDescription, middle_px},
    noise,
    optics::{Pinhole, Placement},
    panel::{Panel, reach_px},
    polarization::{Analyser, Ray, across},
    print::Print,
    rig::RigError,
    scene::{Material, Scene},
    script::Bump,
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
    /// Factor of the light of each face that its level asks for.
    factors: Vec<f32>,
}

/// Everything needed to look along a ray.
#[derive(Clone)]
struct Tracer<'a> {
    camera: Pinhole,
    /// The camera's centre and axes in its own frame before a bump.
    eye: Vector3<f64>,
    turn: Rotation3<f64>,
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
    prints: Vec<Option<&'a Print>>,
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
        let mut world = Self::seen(description, &tracer)?;
        world.factors = world.levels(description, scene, &tracer)?;
        world.set_levels();
        Ok(world)
    }

    /// The same lit as before, after a bump.
    pub(crate) fn bumped(
        &self,
        description: &RigDescription,
        scene: &Scene,
        panel: &Panel,
        bump: &Bump,
    ) -> Result<Self, RigError> {
        let mut tracer = Tracer::new(description, scene, panel)?;
        tracer.bump(scene, bump);
        let mut world = Self { factors: self.factors.clone(), ..Self::seen(description, &tracer)? };
        world.set_levels();
        Ok(world)
    }

    /// What the rays of all pixels meet, in the light that materials return by themselves.
    fn seen(description: &RigDescription, tracer: &Tracer<'_>) -> Result<Self, RigError> {
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
                if let Some(tone) = tracer.tone(pixel, ray, sight.face) {
                    view.gain.iter_mut().for_each(|gain| *gain *= tone);
                }
            }
            Ok(())
        })?;
        let faces =
            tracer.primitives.iter().map(|face| (face.name.clone(), face.shape.is_planar())).collect();
        Ok(Self { width, height, border, views, sights, faces, factors: Vec::new() })
    }

    /// Factor of the light of each face for its object's level: see [`super::scene::Object::level`].
    fn levels(
        &self,
        description: &RigDescription,
        scene: &Scene,
        tracer: &Tracer<'_>,
    ) -> Result<Vec<f32>, RigError> {
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
        Ok(tracer.primitives.iter().map(|face| (factors[face.object].unwrap_or(light)) as f32).collect())
    }

    fn set_levels(&mut self) {
        let per_face = &self.factors;
        self.views.par_iter_mut().zip(&self.sights).for_each(|(view, sight)| {
            if let Some(factor) = per_face.get(usize::from(sight.face)) {
                view.gain.iter_mut().for_each(|gain| *gain *= factor);
            }
        });
    }

    /// Most light of any lit pixel of each object under uniform H, within the sensor, through an analyser that stands
    /// right: a level is a property of the scene's light, which a turned analyser must not make up for.
    fn brightest(&self, description: &RigDescription, tracer: &Tracer<'_>, objects: usize) -> Vec<f64> {
        let turned = description.analyser.as_ref().is_some_and(|analyser| analyser.azimuth_error_deg != 0.0);
        let aligned = turned.then(|| tracer.aligned(description));
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
                for (x, (view, sight)) in self.views[row.clone()].iter().zip(&self.sights[row]).enumerate() {
                    if sight.is_lit() {
                        let object = tracer.primitives[usize::from(sight.face)].object;
                        let pixel = [x as f64, (y - self.border) as f64];
                        let again =
                            aligned.as_ref().and_then(|tracer| Some(tracer.look(tracer.camera.ray(pixel)?)));
                        let gain = again.map_or(view.gain, |(view, _)| view.gain);
                        let seen: f64 =
                            drive.iter().zip(gain).map(|(drive, gain)| drive * f64::from(gain)).sum();
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
            eye: Vector3::zeros(),
            turn: Rotation3::identity(),
            projector: projector_lens(description),
            projector_horizontal: placement.rotation.transpose() * Vector3::x(),
            placement,
            panel,
            size: projector.size.map(f64::from),
            analyser,
            channels,
            primitives: scene.primitives(),
            materials,
            prints: scene.objects.iter().map(|object| object.print.as_ref()).collect(),
            seed: description.seed,
        })
    }

    /// The same with the analyser's axis level.
    fn aligned(&self, description: &RigDescription) -> Self {
        let analyser = description.analyser.as_ref();
        let analyser = analyser.map_or(Analyser::NONE, |analyser| Analyser::linear(0.0, analyser.extinction));
        Self { analyser, ..self.clone() }
    }

    /// Moves what was bumped.
    fn bump(&mut self, scene: &Scene, bump: &Bump) {
        match bump {
            Bump::Camera { by_mm, turn_deg: [x, y, z] } => {
                self.eye = Vector3::from(*by_mm);
                self.turn = Rotation3::from_euler_angles(x.to_radians(), y.to_radians(), z.to_radians());
            }
            Bump::Object { name, by_mm } => {
                for face in &mut self.primitives {
                    if scene.objects[face.object].name == *name {
                        face.shift(Vector3::from(*by_mm));
                    }
                }
            }
        }
    }

    /// What is seen along a ray of the camera.
    fn look(&self, ray: Vector3<f64>) -> (View, Sight) {
        let ray = self.turn * ray;
        let Some((face, distance)) = nearest(&self.primitives, self.eye, ray) else {
            return (View::DARK, Sight::NOTHING);
        };
        let point = self.eye + ray * distance;
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

    /// What a print leaves of the light of a pixel, whose whole area counts: edges of a print are measured to a
    /// hundredth of it. `None` where nothing is printed.
    fn tone(&self, pixel: [f64; 2], ray: Vector3<f64>, face: u8) -> Option<f32> {
        let primitive = self.primitives.get(usize::from(face))?;
        let print = self.prints[primitive.object]?;
        let place = |ray: Vector3<f64>| {
            let ray = self.turn * ray;
            let distance = primitive.shape.meet(self.eye, ray)?;
            Some(print.place(self.eye + ray * distance - primitive.shifted))
        };
        let middle = place(ray)?;
        let step = |pixel: [f64; 2]| {
            let at = self.camera.ray(pixel).and_then(place)?;
            Some([at[0] - middle[0], at[1] - middle[1]])
        };
        let [x, y] = pixel;
        let (right, below) = (step([x + 1.0, y]).unwrap_or_default(), step([x, y + 1.0]).unwrap_or_default());
        Some(print.over(middle, right, below) as f32)
    }

    fn texture(&self, material: &Material, primitive: &Primitive, point: Vector3<f64>) -> f64 {
        if material.texture == 0.0 {
            return 0.0;
        }
        let on_object = point - primitive.shifted;
        texture(noise::mix(self.seed ^ noise::mix(primitive.object as u64)), on_object, material.texture_mm)
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
                *seen += strength * reflected.through(self.analyser, self.turn * Vector3::x());
            }
        }
        seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::{scene::Scene, testing};

    fn config(name: &str) -> toml::Table {
        let path = format!("{}/../config/{name}", env!("CARGO_MANIFEST_DIR"));
        std::fs::read_to_string(path).unwrap().parse().unwrap()
    }

    fn numbers(value: &toml::Value) -> Vec<f64> {
        match value {
            toml::Value::Array(values) => values.iter().flat_map(numbers).collect(),
            value => vec![value.as_float().or(value.as_integer().map(|v| v as f64)).unwrap()],
        }
    }

    /// OpenCV's projection, written out: x = X / Z, then distortion k1 k2 p1 p2 k3, then the matrix.
    fn opencv(device: &toml::Value, [x, y, z]: [f64; 3]) -> [f64; 2] {
        let (m, d) = (numbers(&device["matrix"]), numbers(&device["distortion"]));
        let (x, y) = (x / z, y / z);
        let r2 = x * x + y * y;
        let radial = 1.0 + d[0] * r2 + d[1] * r2.powi(2) + d[4] * r2.powi(3);
        let xd = x * radial + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x);
        let yd = y * radial + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y;
        [m[0] * xd + m[2], m[4] * yd + m[5]]
    }

    #[test]
    fn the_calibration_file_of_the_paper_rig_is_true() {
        let description: RigDescription = config("sim.toml")["sim"].clone().try_into().unwrap();
        let file = config("sim-calibration.toml");
        let rotation = numbers(&file["transform"]["rotation"]);
        let translation = numbers(&file["transform"]["translation_mm"]);
        let (camera, projector) = (camera_lens(&description), projector_lens(&description));
        let placement = placement(&description).unwrap();
        for number in 0..2000u64 {
            let random = |axis: u64| noise::mix(3 * number + axis) as f64 / u64::MAX as f64;
            let point =
                Vector3::new(400.0 * random(0) - 200.0, 300.0 * random(1) - 150.0, 800.0 + 400.0 * random(2));
            let ours = camera.project(point).unwrap();
            let theirs = opencv(&file["camera"], point.into());
            let in_projector: [f64; 3] = std::array::from_fn(|row| {
                (0..3).map(|axis| rotation[3 * row + axis] * point[axis]).sum::<f64>() + translation[row]
            });
            let lit = projector.project(placement.transform(point)).unwrap();
            let expected = opencv(&file["projector"], in_projector);
            for axis in 0..2 {
                assert!((ours[axis] - theirs[axis]).abs() < 1e-6);
                assert!((lit[axis] - expected[axis]).abs() < 1e-6, "{point}: {lit:?} {expected:?}");
            }
        }
        let size = |device: &str| numbers(&file[device]["size"]);
        assert_eq!(size("camera"), description.camera.size.map(f64::from));
        assert_eq!(size("projector"), description.projector.size.map(f64::from));
    }

    /// Truth of one pixel the slow way: march along the ray until a surface is crossed, and from there to the light.
    struct Oracle<'a> {
        description: &'a RigDescription,
        surfaces: &'a [Height],
    }

    /// Height of a point above the surface of an object, positive on the camera's side; `None` beside it.
    type Height = fn([f64; 3]) -> Option<f64>;

    impl Oracle<'_> {
        /// Which surface a straight line crosses first, and where (share of the way).
        fn crossing(&self, from: [f64; 3], to: [f64; 3], steps: u32) -> Option<(usize, [f64; 3])> {
            let at =
                |t: f64| -> [f64; 3] { std::array::from_fn(|axis| from[axis] + t * (to[axis] - from[axis])) };
            for step in 0..steps {
                let (a, b) = (f64::from(step) / f64::from(steps), f64::from(step + 1) / f64::from(steps));
                for (number, height) in self.surfaces.iter().enumerate() {
                    let side = |t| height(at(t));
                    if let (Some(before), Some(after)) = (side(a), side(b))
                        && (before > 0.0) != (after > 0.0)
                    {
                        let (mut low, mut high) = (a, b);
                        for _ in 0..60 {
                            let middle = 0.5 * (low + high);
                            let same = side(middle).is_some_and(|value| (value > 0.0) == (before > 0.0));
                            if same { low = middle } else { high = middle }
                        }
                        return Some((number, at(low)));
                    }
                }
            }
            None
        }

        /// (object, z, lit) for a pixel of a camera without distortion.
        fn truth(&self, x: f64, y: f64) -> Option<(usize, f64, bool)> {
            let camera = &self.description.camera;
            let [cx, cy] = middle_px(camera.size);
            let far = 1500.0;
            let end = [(x - cx) / camera.focal_px * far, (y - cy) / camera.focal_px * far, far];
            let (object, point) = self.crossing([0.0; 3], end, 30_000)?;
            // Start a little above the surface.
            let light = [52.4, 0.0, 0.0];
            let start: [f64; 3] =
                std::array::from_fn(|axis| point[axis] + 1e-4 * (light[axis] - point[axis]));
            Some((object, point[2], self.crossing(start, light, 30_000).is_none()))
        }
    }

    #[test]
    fn truth_agrees_with_marching_along_rays() {
        let scene: Scene = toml::from_str(
            r#"
            [materials.plaster]
            diffuse = 0.8
            [[objects]]
            name = "wall"
            material = "plaster"
            level = 0.5
            shape = { plane = { point_mm = [0.0, 0.0, 1050.0], normal = [0.1, 0.02, -1.0] } }
            [[objects]]
            name = "plate"
            material = "plaster"
            shape = { plane = { point_mm = [0.0, 0.0, 900.0], normal = [-0.1, 0.05, -1.0], x_mm = [-120.0, -30.0], y_mm = [-80.0, 60.0] } }
            [[objects]]
            name = "ball"
            material = "plaster"
            shape = { sphere = { centre_mm = [60.0, 10.0, 950.0], radius_mm = 50.0 } }
            "#,
        )
        .unwrap();
        let description = testing::small_rig();
        let panel = Panel::new(&description.projector);
        let world = World::new(&description, &scene, &panel).unwrap();
        let surfaces: [Height; 3] = [
            |[x, y, z]| Some(0.1 * x + 0.02 * y - (z - 1050.0)),
            |[x, y, z]| {
                ((-120.0..=-30.0).contains(&x) && (-80.0..=60.0).contains(&y))
                    .then_some(-0.1 * x + 0.05 * y - (z - 900.0))
            },
            |[x, y, z]| Some(((x - 60.0).powi(2) + (y - 10.0).powi(2) + (z - 950.0).powi(2)).sqrt() - 50.0),
        ];
        let oracle = Oracle { description: &description, surfaces: &surfaces };
        let (mut shadows, mut compared, mut differing) = (0, 0, 0);
        for y in (0..240).step_by(7) {
            for x in (0..320).step_by(5) {
                let sight = world.sights[y * world.width + x];
                let Some((object, depth, lit)) = oracle.truth(x as f64, y as f64) else {
                    panic!("nothing met at {x} {y}")
                };
                compared += 1;
                shadows += u32::from(!lit);
                let agree = usize::from(sight.face) == object
                    && (f64::from(sight.depth_mm) - depth).abs() < 1e-3
                    && sight.is_lit() == lit;
                // Steps of 0.05 mm may jump over a grazed rim.
                differing += u32::from(!agree);
                if agree && lit {
                    let position = world.views[y * world.width + x].column;
                    let u = f64::from(position) / f64::from(64 << 11);
                    // The table starts some whole pixels before the panel.
                    assert!(((u - f64::from(sight.at[0])).fract().abs() - 0.5).abs() > 0.499);
                }
            }
        }
        assert!(shadows > 30, "{shadows}");
        assert!(differing * 200 < compared, "{differing} of {compared}");
    }
}
