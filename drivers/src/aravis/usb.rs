//! What the kernel knows of USB3 Vision cameras: the library does not name those that it may not open.

use std::{
    fs,
    path::{Path, PathBuf},
};

/// Where the kernel lists USB devices.
pub const SYSFS: &str = "/sys/bus/usb/devices";

/// Class and subclass of an interface that speaks USB3 Vision.
const VISION: [&str; 2] = ["ef", "05"];

/// Speed of the first USB 3 in Mbit/s.
const USB3_MBPS: u32 = 5000;

/// A USB camera that is plugged in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UsbCamera {
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Serial number as the kernel read it; makers write it in hexadecimal or decimal.
    pub serial: String,
    /// Speed of the link in Mbit/s.
    pub speed_mbps: u32,
    /// Device node.
    pub node: PathBuf,
}

impl UsbCamera {
    /// Why the link does not do, if so.
    pub fn slow(&self) -> Option<String> {
        (self.speed_mbps < USB3_MBPS).then(|| {
            format!(
                "is linked at {} Mbit/s: plug it into a USB 3 port with a USB 3 cable, without a hub",
                self.speed_mbps
            )
        })
    }

    /// Why this process may not use it, if so.
    pub fn forbidden(&self) -> Option<String> {
        let open = fs::OpenOptions::new().read(true).write(true).open(&self.node);
        let denied = open.is_err_and(|error| error.kind() == std::io::ErrorKind::PermissionDenied);
        denied.then(|| {
            format!(
                "{} may not be opened: install 60-polscan.rules for udev, be in the group it names, and plug the camera in again",
                self.node.display()
            )
        })
    }
}

/// All cameras in a folder of the kernel that lists USB devices: `/sys/bus/usb/devices` outside of tests.
pub fn cameras(devices: &Path) -> Vec<UsbCamera> {
    let names = |folder: &Path| -> Vec<PathBuf> {
        let entries = fs::read_dir(folder).into_iter().flatten();
        let mut paths: Vec<_> = entries.filter_map(|entry| Some(entry.ok()?.path())).collect();
        paths.sort();
        paths
    };
    let read = |folder: &Path, file: &str| {
        fs::read_to_string(folder.join(file)).unwrap_or_default().trim().to_owned()
    };
    let is_vision = |interface: &Path| {
        [read(interface, "bInterfaceClass"), read(interface, "bInterfaceSubClass")] == VISION
    };
    names(devices)
        .into_iter()
        .filter(|device| names(device).iter().any(|interface| is_vision(interface)))
        .map(|device| {
            let number = |file: &str| read(&device, file).parse::<u32>().unwrap_or(0);
            UsbCamera {
                vendor: read(&device, "manufacturer"),
                model: read(&device, "product"),
                serial: read(&device, "serial"),
                speed_mbps: number("speed"),
                node: format!("/dev/bus/usb/{:03}/{:03}", number("busnum"), number("devnum")).into(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_are_told_from_other_devices_with_their_speed() {
        let root = tempfile::tempdir().unwrap();
        let device = |name: &str, class: &str, speed: &str| {
            let device = root.path().join(name);
            let interface = device.join(format!("{name}:1.0"));
            fs::create_dir_all(&interface).unwrap();
            for (file, text) in [
                ("manufacturer", "Maker"),
                ("product", "Camera 1"),
                ("serial", "0123ABCD"),
                ("speed", speed),
                ("busnum", "2"),
                ("devnum", "17"),
            ] {
                fs::write(device.join(file), format!("{text}\n")).unwrap();
            }
            fs::write(interface.join("bInterfaceClass"), format!("{class}\n")).unwrap();
            fs::write(interface.join("bInterfaceSubClass"), "05\n").unwrap();
        };
        device("2-1", "ef", "5000");
        device("1-3", "ef", "480");
        device("1-4", "08", "480");
        let found = cameras(root.path());
        assert_eq!(found.len(), 2);
        assert!(found[0].slow().is_some_and(|why| why.contains("480")));
        assert_eq!(found[1].slow(), None);
        assert_eq!((found[1].serial.as_str(), found[1].model.as_str()), ("0123ABCD", "Camera 1"));
        assert_eq!(found[1].node, Path::new("/dev/bus/usb/002/017"));
        assert_eq!(cameras(Path::new("/nowhere")), []);
    }

    #[test]
    fn a_node_that_may_not_be_opened_is_told_from_one_that_is_not_there() {
        let mut camera = UsbCamera {
            vendor: String::new(),
            model: String::new(),
            serial: String::new(),
            speed_mbps: 5000,
            node: "/nowhere".into(),
        };
        assert_eq!(camera.forbidden(), None);
        let root = tempfile::tempdir().unwrap();
        camera.node = root.path().join("node");
        fs::write(&camera.node, "").unwrap();
        assert_eq!(camera.forbidden(), None);
    }
}
