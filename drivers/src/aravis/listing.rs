//! Which cameras there are, and why one cannot be used.

use std::path::Path;

use aravis::{GvDevice, glib::prelude::*, prelude::*};

use super::{
    health::Health,
    library::{self, Found},
    usb::{self, UsbCamera},
};
use crate::camera::Listing;

/// What to do about a camera that cannot be opened, from the words of the library.
pub fn hint(message: &str) -> &'static str {
    let message = message.to_lowercase();
    let says = |words: &[&str]| words.iter().any(|word| message.contains(word));
    if says(&["claim", "access", "permission"]) {
        "install 60-polscan.rules for udev, close other camera programs, and plug the camera in again"
    } else if says(&["controller", "privilege"]) {
        "close the program that uses it"
    } else if says(&["bootstrap"]) {
        "it may have been left streaming by a program that was killed: plug it in again"
    } else {
        "check power, cable and address"
    }
}

/// All cameras that answer, and USB cameras that may not be opened.
pub fn list(health: &Health) -> Vec<Listing> {
    let plugged = usb::cameras(Path::new(usb::SYSFS));
    let found = library::discover();
    let mut listings: Vec<Listing> =
        found.iter().map(|camera| listing(camera, unusable(camera, health, &plugged))).collect();
    for camera in plugged.iter().filter(|camera| !found.iter().any(|found| same(found, camera))) {
        let why = camera.forbidden().or_else(|| camera.slow());
        listings.push(Listing {
            driver: super::NAME.to_owned(),
            model: format!("{} {}", camera.vendor, camera.model).trim().to_owned(),
            serial: camera.serial.clone(),
            unusable: Some(why.unwrap_or_else(|| "does not answer; plug it in again".to_owned())),
        });
    }
    listings
}

fn listing(camera: &Found, unusable: Option<String>) -> Listing {
    Listing {
        driver: super::NAME.to_owned(),
        model: format!("{} {}", camera.vendor, camera.model).trim().to_owned(),
        serial: if camera.serial.is_empty() { camera.id.clone() } else { camera.serial.clone() },
        unusable,
    }
}

/// Serial numbers are compared as numbers too: the kernel's is often in hexadecimal.
fn same(found: &Found, plugged: &UsbCamera) -> bool {
    let kernel = u64::from_str_radix(&plugged.serial, 16).ok();
    found.serial == plugged.serial || kernel.is_some() && found.serial.parse().ok() == kernel
}

/// Why a camera that answers cannot be used. One that this process uses is well.
fn unusable(camera: &Found, health: &Health, plugged: &[UsbCamera]) -> Option<String> {
    let names = [&camera.serial, &camera.id, &camera.address];
    if names.into_iter().any(|name| health.is_taken(name)) {
        return None;
    }
    if let Some(why) = plugged.iter().filter(|usb| same(camera, usb)).find_map(|usb| usb.slow()) {
        return Some(why);
    }
    match library::open(&camera.id) {
        Ok(opened) => {
            let device = opened.device();
            let device = device.as_ref().and_then(|device| device.downcast_ref::<GvDevice>());
            let busy = device.is_some_and(|device| !device.is_controller());
            busy.then(|| "is used by another program; close that first".to_owned())
        }
        Err(error) => Some(format!("cannot be opened ({}); {}", error.message(), hint(error.message()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_of_the_kernel_is_known_by_its_number_in_either_notation() {
        let found = |serial: &str| Found {
            id: "Maker-1".into(),
            vendor: "Maker".into(),
            model: "Camera".into(),
            serial: serial.into(),
            address: String::new(),
            protocol: "USB3Vision".into(),
        };
        let plugged = |serial: &str| UsbCamera {
            vendor: String::new(),
            model: String::new(),
            serial: serial.into(),
            speed_mbps: 5000,
            node: "/nowhere".into(),
        };
        assert!(same(&found("19088743"), &plugged("01234567")));
        assert!(same(&found("X17"), &plugged("X17")));
        assert!(!same(&found("19088744"), &plugged("01234567")));
        assert!(!same(&found("X18"), &plugged("X17")));
    }

    #[test]
    fn the_words_of_the_library_lead_to_a_next_step() {
        assert!(hint("Failed to claim USB interface to 'x'").contains("udev"));
        assert!(hint("Controller privilege required").contains("close the program"));
        assert!(hint("Failed to bootstrap USB device 'x'").contains("plug it in again"));
        assert!(hint("timeout").contains("power"));
    }
}
