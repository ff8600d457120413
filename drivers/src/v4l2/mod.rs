//! Cameras of the kernel's own video interface (Video4Linux): webcams, grabbers, cameras on a board.
//!
//! Such a camera has no trigger: it runs by itself, and frames are chosen by their stamps. One thread owns the node
//! and its stream and takes every frame, wanted or not, so that none grows old in a queue. The camera that is handed out only
//! sends it work. A camera that was unplugged says so; it is found again by what identifies it, never by its number.

mod camera;
mod choice;
mod controls;
mod device;
mod format;
mod kernel;
mod listing;

use std::{
    collections::BTreeSet,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
};

use listing::Place;

use crate::{
    camera::{Camera, CameraDriver, Listing},
    clock::Clock,
    error::DeviceError,
};

/// Name of the driver in listings and configurations.
const NAME: &str = "v4l2";

/// Cameras that this process has open.
static TAKEN: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// What a user can say about a camera beyond the settings that every camera has.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// Settings that the camera may have otherwise, by name, such as `gamma`.
    pub allow: Vec<String>,
    /// Value of the camera's own gain that stands for `gain_db`.
    pub gain_raw: Option<f64>,
    /// Value of the brightness control; `None` leaves it as it is.
    pub black_level: Option<f64>,
    /// Exposure time of a camera that has no control for it, in microseconds.
    pub fixed_exposure_us: Option<f64>,
    /// Columns and rows of the frames that it shall send; `None` takes the most.
    pub frame_size: Option<(u32, u32)>,
    /// Frames to skip after those that can have been exposed too early.
    pub skip_frames: u32,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            allow: Vec::new(),
            gain_raw: None,
            black_level: None,
            fixed_exposure_us: None,
            frame_size: None,
            skip_frames: 1,
        }
    }
}

/// Driver of all video nodes.
#[derive(Debug, Clone)]
pub struct V4l2Cameras {
    options: Options,
    clock: Arc<dyn Clock>,
}

impl V4l2Cameras {
    /// A driver whose cameras stamp frames by `clock`, which must be a real one.
    pub fn new(options: Options, clock: Arc<dyn Clock>) -> Self {
        Self { options, clock }
    }
}

/// A camera that is taken until this is dropped.
#[derive(Debug)]
struct Taken(PathBuf);

impl Taken {
    fn set() -> std::sync::MutexGuard<'static, BTreeSet<PathBuf>> {
        TAKEN.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn new(node: PathBuf) -> Option<Self> {
        // Made only where it is free: one that is dropped gives the camera back.
        Self::set().insert(node.clone()).then(|| Self(node))
    }
}

impl Drop for Taken {
    fn drop(&mut self) {
        Self::set().remove(&self.0);
    }
}

/// The camera that `serial` selects of those that were found; `None` selects the only one.
fn select<'a>(places: &'a [Place], serial: Option<&str>) -> Result<&'a Place, DeviceError> {
    let all = places.iter().map(|place| place.serial.as_str()).collect::<Vec<_>>().join(", ");
    let mut fitting = places.iter().filter(|place| serial.is_none_or(|serial| place.answers_to(serial)));
    let detail = match (fitting.next(), fitting.next()) {
        (Some(place), None) => return Ok(place),
        (Some(_), Some(_)) => format!("there are several ({all}); name one in camera.serial"),
        (None, _) if places.is_empty() => "no camera is connected; check power and cable".to_owned(),
        (None, _) => format!("not connected, there is {all}; plug it in, or correct camera.serial"),
    };
    Err(DeviceError::Unavailable { device: serial.unwrap_or("camera").to_owned(), detail })
}

impl CameraDriver for V4l2Cameras {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        let taken = |place: &Place| Taken::set().contains(&place.node);
        Ok(listing::places().iter().map(|place| listing::listing(place, taken(place))).collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError> {
        let places = listing::places();
        let place = select(&places, serial)?;
        let unavailable = |detail: String| DeviceError::Unavailable { device: place.serial.clone(), detail };
        let taken = Taken::new(place.node.clone())
            .ok_or_else(|| unavailable("is open already; close it first".to_owned()))?;
        if let Some(why) = listing::unusable(place) {
            return Err(unavailable(why));
        }
        camera::open(place, self.options.clone(), self.clock.clone(), taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn place(serial: &str, node: &str) -> Place {
        Place {
            node: node.into(),
            model: "Camera".into(),
            serial: serial.into(),
            aliases: vec!["usb-1".into()],
        }
    }

    #[test]
    fn a_camera_is_selected_by_what_identifies_it_or_by_being_the_only_one() {
        let one = [place("17", "/dev/video0")];
        let two = [place("17", "/dev/video0"), place("18", "/dev/video2")];
        assert_eq!(select(&one, None).unwrap().serial, "17");
        assert_eq!(select(&one, Some("usb-1")).unwrap().serial, "17");
        assert_eq!(select(&two, Some("18")).unwrap().serial, "18");
        assert_eq!(select(&two, Some("/dev/video2")).unwrap().serial, "18");
        for (places, serial, words) in [
            (&two[..0], None, "no camera is connected"),
            (&two[..], None, "there are several (17, 18)"),
            (&two[..], Some("usb-1"), "there are several"),
            (&two[..], Some("19"), "there is 17, 18"),
        ] {
            let error = select(places, serial).unwrap_err();
            assert!(error.to_string().contains(words), "{error}");
        }
    }

    #[test]
    fn a_camera_is_taken_once() {
        let node = PathBuf::from("/dev/video-of-this-test");
        let taken = Taken::new(node.clone()).unwrap();
        assert!(Taken::new(node.clone()).is_none());
        drop(taken);
        assert!(Taken::new(node).is_some());
    }
}
