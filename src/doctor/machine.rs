//! What the machine's own files say.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::{Finding, Level};
use crate::app::usb_cameras;

/// Where udev looks for rules.
const RULES: [&str; 4] = ["etc/udev/rules.d", "run/udev/rules.d", "usr/lib/udev/rules.d", "lib/udev/rules.d"];

/// What a rule for cameras of USB3 Vision names: their class of interface, or the maker of the cameras that this was made for.
const RULE_MARKS: [&str; 2] = ["ef05", "1e10"];

/// Memory of the kernel that transfers of one camera need: two frames of 8 MiB.
const USB_MIB_PER_CAMERA: u64 = 16;

/// Receive buffer of a network socket that keeps a frame of 1600 x 1200 pixels of 16 bit.
const NETWORK_BUFFER: u64 = 4 << 20;

/// Clocks of the kernel that take microseconds to be read or step by as much.
const SLOW_CLOCKS: [&str; 4] = ["hpet", "acpi_pm", "jiffies", "refined-jiffies"];

const GIB: f64 = (1u64 << 30) as f64;

/// A machine, by the root of its file system.
#[derive(Debug, Clone)]
pub struct Machine {
    root: PathBuf,
}

impl Machine {
    /// The machine whose files are under `root`: `/`, outside of tests.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned() }
    }

    fn line(&self, path: &str) -> Option<String> {
        Some(fs::read_to_string(self.root.join(path)).ok()?.trim().to_owned())
    }

    /// What cameras on USB and on the network need of the kernel.
    pub fn usb(&self) -> Vec<Finding> {
        let cameras = usb_cameras(&self.root.join("sys/bus/usb/devices")) as u64;
        let mut findings = vec![self.rule(cameras)];
        // A kernel without USB has no such memory.
        if let Some(text) = self.line("sys/module/usbcore/parameters/usbfs_memory_mb") {
            findings.push(usb_memory(&text, cameras.max(1)));
        }
        if cameras == 0
            && let Some(text) = self.line("proc/sys/net/core/rmem_max")
        {
            findings.push(network_buffer(&text));
        }
        findings
    }

    fn rule(&self, cameras: u64) -> Finding {
        let has_mark = |path: &Path| {
            fs::read_to_string(path).is_ok_and(|text| RULE_MARKS.iter().any(|mark| text.contains(mark)))
        };
        let files =
            RULES.iter().filter_map(|folder| fs::read_dir(self.root.join(folder)).ok()).flatten().flatten();
        let found = files
            .map(|entry| entry.path())
            .filter(|path| path.extension().is_some_and(|extension| extension == "rules"))
            .find(|path| has_mark(path));
        match found {
            Some(path) => {
                Finding::new("udev-rule", Level::Ok, format!("{} is for USB cameras", path.display()))
            }
            None => {
                // Whoever is root needs no rule, and a camera on the network none either.
                let level = if cameras > 0 { Level::Warning } else { Level::Ok };
                let next = "install systemd/60-polscan.rules in /etc/udev/rules.d, run `udevadm control --reload`, and \
                            plug the camera in again";
                Finding::new(
                    "udev-rule",
                    level,
                    format!("no rule is for USB cameras; if there is one, {next}"),
                )
            }
        }
    }

    /// Whether scans have room.
    pub fn disk(&self, folder: &Path, min_free_gib: f64) -> Finding {
        let existing =
            folder.ancestors().find(|path| path.exists()).filter(|path| !path.as_os_str().is_empty());
        let place = existing.unwrap_or(Path::new("."));
        let found = |level, message| Finding::new("disk", level, message);
        let shown = folder.display();
        if let Err(error) = rustix::fs::access(place, rustix::fs::Access::WRITE_OK) {
            let next = "give it to the user of the service, or correct store.dir";
            return found(Level::Bad, format!("{} may not be written to ({error}); {next}", place.display()));
        }
        match rustix::fs::statvfs(place) {
            Err(error) => found(Level::Warning, format!("the room for {shown} is not known ({error})")),
            Ok(room) => {
                let free_gib = room.f_bavail.saturating_mul(room.f_frsize) as f64 / GIB;
                room_for(&shown.to_string(), free_gib, min_free_gib)
            }
        }
    }

    /// Whether time is measured well.
    pub fn clock(&self) -> Finding {
        let Some(name) = self.line("sys/devices/system/clocksource/clocksource0/current_clocksource") else {
            return Finding::new("clock", Level::Warning, "the kernel does not say by what it measures time");
        };
        if SLOW_CLOCKS.contains(&name.as_str()) {
            let message = format!(
                "the kernel measures time by {name}, which is slow or coarse; choose another in \
                 /sys/devices/system/clocksource/clocksource0 or in the firmware's settings"
            );
            return Finding::new("clock", Level::Warning, message);
        }
        Finding::new("clock", Level::Ok, format!("the kernel measures time by {name}"))
    }
}

fn usb_memory(text: &str, cameras: u64) -> Finding {
    let found = |level, message| Finding::new("usb-memory", level, message);
    let needed = USB_MIB_PER_CAMERA * cameras;
    match text.parse::<u64>() {
        Ok(0) => found(Level::Ok, "is not limited".to_owned()),
        Ok(limit) if limit >= needed => found(Level::Ok, format!("{limit} MiB, {needed} are needed")),
        Ok(limit) => {
            let next = format!(
                "run `echo {needed} | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb`, and for every start add \
                 usbcore.usbfs_memory_mb={needed} to the kernel's command line"
            );
            found(Level::Warning, format!("{limit} MiB for all transfers, {needed} are needed; {next}"))
        }
        Err(_) => found(Level::Warning, format!("the kernel says `{text}`, which is no number")),
    }
}

fn network_buffer(text: &str) -> Finding {
    let found = |level, message| Finding::new("network-buffer", level, message);
    match text.parse::<u64>() {
        Ok(limit) if limit >= NETWORK_BUFFER => found(Level::Ok, format!("{limit} bytes")),
        Ok(limit) => {
            let next = format!(
                "for a camera on the network run `sudo sysctl -w net.core.rmem_max={NETWORK_BUFFER}`, and write the same \
                 to /etc/sysctl.d"
            );
            found(
                Level::Warning,
                format!("{limit} bytes do not hold a frame, so that packets may be lost; {next}"),
            )
        }
        Err(_) => found(Level::Warning, format!("the kernel says `{text}`, which is no number")),
    }
}

fn room_for(folder: &str, free_gib: f64, min_free_gib: f64) -> Finding {
    if free_gib > min_free_gib {
        return Finding::new("disk", Level::Ok, format!("{free_gib:.1} GiB are free for {folder}"));
    }
    let message = format!(
        "{free_gib:.1} GiB are free for {folder}, {min_free_gib:.1} must stay free: no scan starts; delete scans or other \
         files, or lower store.min_free_gib"
    );
    Finding::new("disk", Level::Bad, message)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(files: &[(&str, &str)]) -> (tempfile::TempDir, Machine) {
        let root = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        let machine = Machine::new(root.path());
        (root, machine)
    }

    const CAMERA: [(&str, &str); 3] = [
        ("sys/bus/usb/devices/2-1/speed", "5000\n"),
        ("sys/bus/usb/devices/2-1/2-1:1.0/bInterfaceClass", "ef\n"),
        ("sys/bus/usb/devices/2-1/2-1:1.0/bInterfaceSubClass", "05\n"),
    ];

    fn levels(findings: &[Finding]) -> Vec<(&str, Level)> {
        findings.iter().map(|finding| (finding.check, finding.level)).collect()
    }

    #[test]
    fn a_usb_camera_needs_a_rule_and_memory() {
        let memory = |text| ("sys/module/usbcore/parameters/usbfs_memory_mb", text);
        let (_root, bare) = machine(&[&CAMERA[..], &[memory("8\n")]].concat());
        assert_eq!(levels(&bare.usb()), [("udev-rule", Level::Warning), ("usb-memory", Level::Warning)]);
        let rule = ("usr/lib/udev/rules.d/60-polscan.rules", "ENV{ID_USB_INTERFACES}==\"*:ef05??:*\"\n");
        let (_root, well) = machine(&[&CAMERA[..], &[memory("16\n"), rule]].concat());
        assert_eq!(levels(&well.usb()), [("udev-rule", Level::Ok), ("usb-memory", Level::Ok)]);
        let other = ("etc/udev/rules.d/60-other.rules", "ATTR{idVendor}==\"046d\"\n");
        let (_root, other) = machine(&[&CAMERA[..], &[memory("0\n"), other]].concat());
        assert_eq!(levels(&other.usb()), [("udev-rule", Level::Warning), ("usb-memory", Level::Ok)]);
    }

    #[test]
    fn the_rules_that_are_installed_are_known() {
        let rules = include_str!("../../systemd/60-polscan.rules");
        assert!(RULE_MARKS.iter().all(|mark| rules.contains(mark)), "{rules}");
    }

    #[test]
    fn a_camera_on_the_network_needs_a_buffer() {
        let (_root, small) = machine(&[("proc/sys/net/core/rmem_max", "212992\n")]);
        assert_eq!(levels(&small.usb()), [("udev-rule", Level::Ok), ("network-buffer", Level::Warning)]);
        assert_eq!(network_buffer("33554432").level, Level::Ok);
    }

    #[test]
    fn room_is_judged_where_the_folder_will_be() {
        let (root, machine) = machine(&[]);
        let folder = root.path().join("not/yet/there");
        assert_eq!(machine.disk(&folder, 0.0).level, Level::Ok);
        let full = machine.disk(&folder, 1e9);
        assert!(full.level == Level::Bad && full.message.contains("store.min_free_gib"), "{full:?}");
        // Relative to where the program runs.
        assert_eq!(machine.disk(Path::new("folder-that-is-not-there"), 0.0).level, Level::Ok);
    }

    #[test]
    fn coarse_clocks_are_told() {
        let path = "sys/devices/system/clocksource/clocksource0/current_clocksource";
        for (text, level) in
            [("tsc\n", Level::Ok), ("arch_sys_counter\n", Level::Ok), ("hpet\n", Level::Warning)]
        {
            let (_root, machine) = machine(&[(path, text)]);
            assert_eq!(machine.clock().level, level);
        }
        let (_root, silent) = machine(&[]);
        assert_eq!(silent.clock().level, Level::Warning);
    }
}
