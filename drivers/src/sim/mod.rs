//! The simulated rig: a physically true twin of a scanner, as an ordinary driver.
//!
//! A [`RigDescription`] and a [`Scene`] make a [`Rig`], whose drivers open a camera and a projector like those of any
//! other rig, and which knows the [`Truth`] of each pixel. How light travels:
//!
//! 1. *Panel*: each colour channel leaves the projector linearly polarized, with a finite extinction and a black leak;
//!    the lens blurs the box of each pixel (exact convolution).
//! 2. *Time*: a picture is flipped at a refresh, its light follows after the latency, the liquid crystals follow
//!    exponentially, the lamp may flicker; an exposure integrates all of it analytically into a weighted sum of slides.
//! 3. *Scene*: per pixel one ray; the surface returns a GGX lobe by Fresnel's laws (as a Mueller matrix, complex index)
//!    and a depolarising Lambertian part. Shadows are cast by a ray to the projector. Light is reflected once: what one
//!    surface throws onto another (interreflection) is not modelled.
//! 4. *Camera*: analyser, lens blur and pixel box, shot noise, full well, read noise, gain, black level, quantisation.
//!
//! Everything up to the panel's drive is linear and fixed, so it is computed once: a frame is a table look-up and a
//! product per pixel, then blur and noise. Pixels are sampled at their centres: silhouettes are as sharp as the blur of
//! the camera leaves them.
//!
//! Noise depends on the seed, on the number of the exposure since the rig was made, and on the pixel: never on threads,
//! regions or the time of day. A fresh rig therefore repeats a scan bit by bit, and a second take on the same rig differs
//! from the first.
//!
//! In real time a frame must not come later than its camera would send it, only because a computer paints it: the frames
//! of a scan are rendered before its clock starts (`rehearsal.rs`), for its timetable and with the faults of the
//! description, up to [`REHEARSED_BYTES`]. What is exposed otherwise than scheduled (a re-take and all after it, a flip
//! or a trigger that came late, a lamp that flickers or drifts, light that changes at a set time, automatic exposure) is
//! rendered when it is needed, and is then as late as that takes.
//!
//! A rig simulates devices that behave, unless its description lists faults ([`FaultDescription`]). Each then happens at
//! its own place: those of the display between a request and the timeline (`projector.rs`, `timeline.rs`), of the camera
//! at the sensor (`render.rs`) or between a rendered exposure and its delivery (`camera.rs`), of the scene by a second
//! look at it (`world.rs`). The panel changes as a whole: the scan-out of a picture from top to bottom is not modelled.

mod camera;
mod description;
mod faults;
mod noise;
mod optics;
mod panel;
mod polarization;
mod print;
mod projection;
mod projector;
mod rehearsal;
mod render;
mod rig;
mod scene;
mod script;
mod surface;
#[cfg(test)]
mod testing;
mod timeline;
mod worker;
mod world;

pub use camera::SimCameras;
pub use description::{
    AmbientDescription, AnalyserDescription, CameraDescription, FlickerDescription, Pacing,
    PanelPolarization, PoseDescription, ProjectorDescription, RigDescription,
};
pub use print::Print;
pub use projection::Projection;
pub use projector::SimProjectors;
pub use rehearsal::REHEARSED_BYTES;
pub use rig::{Rig, RigError, Truth, TruthObject};
pub use scene::{Material, Object, Plane, Scene, Shape, Sphere, Step, VGroove, Wedge};
pub use script::FaultDescription;
