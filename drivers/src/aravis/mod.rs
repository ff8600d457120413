//! GenICam cameras (GigE Vision, USB3 Vision) by the Aravis library.
//!
//! The library is not thread-safe: one thread owns each camera with its stream and buffers, and the [`Camera`] that is
//! handed out only sends it commands. Discovery and opening share state of the library and are done one at a time. What
//! was learned of a camera's troubles outlives it, so that one that was lost is opened again ever more carefully.

mod actor;
mod buffers;
mod camera;
mod checklist;
pub mod fake;
mod features;
mod health;
mod identity;
mod library;
mod listing;
mod options;
mod recovery;
mod stream;
mod unpack;
mod usb;

use std::{net::IpAddr, sync::Arc};

use features::Features;
use health::Health;
use library::Found;
pub use library::version;
pub use options::{Options, UsbMode};
use recovery::{Action, Event};
pub use usb::{UsbCamera, cameras as usb_cameras};

use crate::{
    camera::{Camera, CameraDriver, Listing},
    clock::Clock,
    error::DeviceError,
};

/// Name of the driver in listings and configurations.
const NAME: &str = "aravis";

/// Driver of all cameras that the library finds.
#[derive(Debug, Clone)]
pub struct AravisCameras {
    options: Options,
    clock: Arc<dyn Clock>,
    health: Health,
}

impl AravisCameras {
    /// A driver whose cameras stamp frames by `clock`, which must be a real one.
    pub fn new(options: Options, clock: Arc<dyn Clock>) -> Self {
        Self { options, clock, health: Health::of_process() }
    }

    /// Id to open a camera by, and its name in errors and records.
    fn resolve(&self, serial: Option<&str>) -> Result<(String, String), DeviceError> {
        // An address needs no discovery, which takes a second.
        if let Some(address) = serial.filter(|serial| serial.parse::<IpAddr>().is_ok()) {
            return Ok((address.to_owned(), address.to_owned()));
        }
        select(library::discover(), serial)
    }

    /// Opens the camera, tells it to reset itself, and lets go of it.
    fn reset(&self, id: &str, name: &str) {
        let reset = library::open(id).ok().and_then(|camera| Features::new(camera).ok());
        let done = reset.is_some_and(|features| features.execute("DeviceReset").is_ok());
        self.health.enter(name, if done { Event::Reset } else { Event::OpenFailed });
    }
}

/// The camera that `serial` selects of those that were found; `None` selects the only one.
fn select(found: Vec<Found>, serial: Option<&str>) -> Result<(String, String), DeviceError> {
    let name = |camera: &Found| match camera.serial.is_empty() {
        true => camera.id.clone(),
        false => camera.serial.clone(),
    };
    let all = found.iter().map(name).collect::<Vec<_>>().join(", ");
    let wanted = |camera: &&Found| match serial {
        Some(serial) => [&camera.serial, &camera.id, &camera.address].iter().any(|name| *name == serial),
        None => true,
    };
    let mut fitting = found.iter().filter(wanted);
    let (first, second) = (fitting.next(), fitting.next());
    let detail = match (first, second, serial) {
        (Some(camera), None, _) => return Ok((camera.id.clone(), name(camera))),
        (Some(_), Some(_), _) => format!("there are several ({all}); name one in camera.serial"),
        (None, _, Some(_)) if !found.is_empty() => {
            format!("no such camera, there is {all}; correct camera.serial, or check power and cable")
        }
        (None, ..) => "no camera answers; check power and cable, and `polscan devices`".to_owned(),
    };
    let device = serial.unwrap_or("camera").to_owned();
    Err(DeviceError::Unavailable { device, detail })
}

impl CameraDriver for AravisCameras {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(listing::list(&self.health))
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError> {
        let (id, name) = self.resolve(serial)?;
        let unavailable = |detail: String| DeviceError::Unavailable { device: name.clone(), detail };
        let (action, now, failures) = self.health.next(&name);
        match action {
            Action::Wait(until) => {
                let left = until.since(now).as_secs_f64();
                return Err(unavailable(format!(
                    "failed {failures} times in a row and is opened again in {left:.1} s"
                )));
            }
            Action::Reset => {
                self.reset(&id, &name);
                return Err(unavailable(format!("failed {failures} times in a row and is being reset")));
            }
            Action::Open | Action::LastResort => {}
        }
        let taken = self.health.take(&name).map_err(|why| unavailable(why.to_owned()))?;
        let opened =
            camera::open(&id, &name, self.options.clone(), self.clock.clone(), self.health.clone(), taken);
        opened.map_err(|error| {
            self.health.enter(&name, Event::OpenFailed);
            match action {
                Action::LastResort => unavailable(format!(
                    "failed {} times in a row, a reset did not help: unplug it, wait 10 s, plug it in again ({error})",
                    failures + 1
                )),
                _ => error,
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(serial: &str) -> Found {
        Found {
            id: format!("Maker-{serial}"),
            vendor: "Maker".into(),
            model: "Camera".into(),
            serial: serial.into(),
            address: "10.0.0.7".into(),
            protocol: "GigEVision".into(),
        }
    }

    #[test]
    fn a_camera_is_selected_by_serial_or_by_being_the_only_one() {
        let id = |result: Result<(String, String), DeviceError>| result.unwrap().0;
        assert_eq!(id(select(vec![found("17")], None)), "Maker-17");
        assert_eq!(id(select(vec![found("17"), found("18")], Some("18"))), "Maker-18");
        assert_eq!(id(select(vec![found("17")], Some("Maker-17"))), "Maker-17");
        for (cameras, serial, words) in [
            (vec![], None, "no camera answers"),
            (vec![], Some("17"), "no camera answers"),
            (vec![found("17"), found("18")], None, "there are several (17, 18)"),
            (vec![found("17")], Some("19"), "there is 17"),
        ] {
            let error = select(cameras, serial).unwrap_err();
            assert!(error.to_string().contains(words), "{error}");
        }
    }
}
