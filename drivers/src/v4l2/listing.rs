//! Which cameras there are, and why one cannot be used.

use std::{
    fs, io,
    path::{Path, PathBuf},
    sync::Arc,
};

use super::{
    NAME,
    format::{Wire, code_name},
    kernel::{CAN_CAPTURE, CAN_STREAM, Node, Stream},
};
use crate::camera::Listing;

/// Where the kernel describes its video nodes.
const SYSFS: &str = "/sys/class/video4linux";

/// A video node that may be a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// File to open.
    pub node: PathBuf,
    /// Maker and model.
    pub model: String,
    /// Serial number, or where it is connected.
    pub serial: String,
    /// Other names.
    pub aliases: Vec<String>,
}

impl Place {
    /// Whether `name` means this camera.
    pub fn answers_to(&self, name: &str) -> bool {
        self.serial == name || self.node == Path::new(name) || self.aliases.iter().any(|alias| alias == name)
    }
}

/// A file of one line, where there is one.
fn line(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    Some(text.trim().to_owned()).filter(|text| !text.is_empty())
}

/// All nodes that are cameras, and those of which it cannot be known.
pub fn places() -> Vec<Place> {
    let mut places = described(Path::new(SYSFS), Path::new("/dev"));
    places.retain_mut(|place| {
        let Ok(capability) = Node::open(&place.node).and_then(|node| node.capability()) else { return true };
        let bus = capability.bus();
        if place.serial.is_empty() {
            place.serial.clone_from(&bus);
        }
        place.aliases.push(bus);
        place.model = capability.card();
        // Other nodes of a camera carry its metadata, and displays have nodes too.
        let needed = CAN_CAPTURE | CAN_STREAM;
        capability.abilities() & needed == needed
    });
    for place in &mut places {
        if place.serial.is_empty() {
            place.serial = place.node.display().to_string();
        }
    }
    places
}

/// All nodes under `sysfs`, as far as that describes them, in the order of their numbers.
fn described(sysfs: &Path, dev: &Path) -> Vec<Place> {
    let names = fs::read_dir(sysfs).into_iter().flatten().flatten();
    let names = names.filter_map(|entry| entry.file_name().into_string().ok());
    let mut numbers: Vec<u32> = names.filter_map(|name| name.strip_prefix("video")?.parse().ok()).collect();
    numbers.sort_unstable();
    let place = |number: &u32| {
        let name = format!("video{number}");
        let folder = sysfs.join(&name);
        // A USB camera's node belongs to an interface of the device that has the number.
        let device = folder.join("device").canonicalize().ok();
        let usb = device.as_deref().and_then(Path::parent);
        Place {
            node: dev.join(&name),
            model: line(&folder.join("name")).unwrap_or_default(),
            serial: usb.and_then(|usb| line(&usb.join("serial"))).unwrap_or_default(),
            aliases: by_id(dev, &name),
        }
    };
    numbers.iter().map(place).collect()
}

/// Names that udev gives a node after what identifies it.
fn by_id(dev: &Path, node: &str) -> Vec<String> {
    let links = fs::read_dir(dev.join("v4l/by-id")).into_iter().flatten().flatten();
    let leads_there = |link: &PathBuf| fs::read_link(link).is_ok_and(|target| target.ends_with(node));
    let links = links.map(|link| link.path()).filter(leads_there);
    links.filter_map(|link| Some(link.file_name()?.to_str()?.to_owned())).collect()
}

/// What to do about a node that cannot be opened.
fn hint(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            "add the user of this program to the group video (usermod -aG video USER) and log in again"
        }
        io::ErrorKind::ResourceBusy => "close the program that uses it",
        io::ErrorKind::NotFound => "there is no node for it; check udev",
        _ => "plug it in again",
    }
}

/// Why a camera that nobody in this process uses cannot be used.
pub fn unusable(place: &Place) -> Option<String> {
    let failed = |what: &str, error: io::Error| Some(format!("{what} ({error}); {}", hint(&error)));
    let node = match Node::open(&place.node) {
        Ok(node) => Arc::new(node),
        Err(error) => return failed("cannot be opened", error),
    };
    let formats = node.formats();
    if !Wire::ALL.iter().any(|wire| formats.contains(&wire.fourcc())) {
        let offered = formats.iter().map(|&code| code_name(code)).collect::<Vec<_>>().join(", ");
        let known = Wire::ALL.map(|wire| code_name(wire.fourcc())).join(", ");
        return Some(format!("sends {offered} only, which hide or bend brightness; {known} can be used"));
    }
    // Whoever streams owns the buffers, so that asking for some tells.
    match Stream::probe(&node) {
        Err(error) if error.kind() == io::ErrorKind::ResourceBusy => {
            failed("is used by another program", error)
        }
        Err(error) => failed("gives no buffers", error),
        Ok(()) => None,
    }
}

/// The camera as a line of a list; one that this process uses is well.
pub fn listing(place: &Place, taken: bool) -> Listing {
    Listing {
        driver: NAME.to_owned(),
        model: place.model.clone(),
        serial: place.serial.clone(),
        unusable: if taken { None } else { unusable(place) },
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn nodes_are_named_by_the_device_that_they_belong_to() {
        let folder = tempfile::tempdir().unwrap();
        let (sysfs, dev) = (folder.path().join("class"), folder.path().join("dev"));
        let usb = folder.path().join("devices/usb1/1-1");
        for (number, interface) in [(10, "1-1:1.0"), (2, "1-1:1.1")] {
            let node = sysfs.join(format!("video{number}"));
            fs::create_dir_all(&node).unwrap();
            fs::create_dir_all(usb.join(interface)).unwrap();
            fs::write(node.join("name"), format!("Camera {number}\n")).unwrap();
            symlink(usb.join(interface), node.join("device")).unwrap();
        }
        fs::create_dir_all(sysfs.join("v4l-subdev0")).unwrap();
        fs::write(usb.join("serial"), "A17\n").unwrap();
        fs::create_dir_all(dev.join("v4l/by-id")).unwrap();
        symlink("../../video2", dev.join("v4l/by-id/usb-Maker_Camera_A17-video-index0")).unwrap();

        let found = described(&sysfs, &dev);
        let models: Vec<_> = found.iter().map(|place| place.model.as_str()).collect();
        assert_eq!(models, ["Camera 2", "Camera 10"]);
        assert!(found.iter().all(|place| place.serial == "A17"));
        assert!(found[0].answers_to("usb-Maker_Camera_A17-video-index0"));
        assert!(!found[1].answers_to("usb-Maker_Camera_A17-video-index0"));
        assert_eq!(found[1].node, dev.join("video10"));
        assert_eq!(described(&folder.path().join("nowhere"), &dev), []);
    }

    #[test]
    fn what_is_no_camera_is_said_with_a_next_step() {
        let missing = Place {
            node: "/dev/video-that-is-not".into(),
            model: String::new(),
            serial: String::new(),
            aliases: Vec::new(),
        };
        assert!(unusable(&missing).is_some_and(|why| why.contains("check udev")));
        let denied = io::Error::from_raw_os_error(13);
        assert!(hint(&denied).contains("group video"));
        assert!(hint(&io::Error::from_raw_os_error(16)).contains("close the program"));
    }
}
