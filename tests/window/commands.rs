//! `polscan show` and `polscan devices`.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
};

use polscan_patterns::{ChannelSet, Picture, Polarization, ProjectorSize};
use rustix::process::{Pid, Signal, kill_process};

use crate::{
    PROGRAM,
    xvfb::{Xvfb, eventually},
};

const POLARIZATION: Polarization = Polarization {
    horizontal: ChannelSet { red: false, green: true, blue: false },
    vertical: ChannelSet { red: true, green: false, blue: true },
};

/// The program with a window on `xvfb` as its projector.
fn program(xvfb: &Xvfb, arguments: &[&str]) -> Command {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).env("POLSCAN_PROJECTOR__DRIVER", "window");
    command.env("POLSCAN_PROJECTOR__X11_DISPLAY", xvfb.display()).env_remove("DISPLAY");
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The first line that a program prints.
fn first_line(child: &mut Child) -> String {
    let mut line = String::new();
    let out = child.stdout.as_mut().expect("its output");
    BufReader::new(out).read_line(&mut line).expect("a line");
    line.trim().to_owned()
}

fn interrupt(child: &mut Child) -> Option<i32> {
    let pid = Pid::from_raw(child.id() as i32).expect("a process");
    kill_process(pid, Signal::INT).expect("it runs");
    child.wait().expect("it ends").code()
}

#[test]
fn a_picture_is_held_until_an_interrupt_and_black_comes_after_it() {
    let xvfb = Xvfb::start(640, 480);
    let size = ProjectorSize { width: 640, height: 480 };
    for picture in [Picture::Checker, Picture::Focus, Picture::H] {
        let mut shown = program(&xvfb, &["show", picture.name()]).spawn().expect("the program");
        let line = first_line(&mut shown);
        let wanted = format!("showing {picture} on display without EDID screen (640x480); interrupt to end");
        assert_eq!(line, wanted);
        assert!(xvfb.screen() == picture.raster(size, POLARIZATION).to_rgb(size), "{picture}");
        assert_eq!(interrupt(&mut shown), Some(0));
        eventually("the window is gone", || xvfb.screen().iter().all(|byte| *byte == 0));
    }
}

#[test]
fn a_pattern_is_held_on_the_simulated_projector_too() {
    let config = concat!(env!("CARGO_MANIFEST_DIR"), "/config/sim.toml");
    for name in ["column-3-inverse", "white"] {
        let mut command = Command::new(PROGRAM);
        command.args(["--json", "show", name, "--config", config]).stdout(Stdio::piped());
        let mut shown = command.spawn().expect("the program");
        let said: serde_json::Value = serde_json::from_str(&first_line(&mut shown)).expect("JSON");
        assert_eq!((&said["show"], &said["projector"]["driver"]), (&name.into(), &"sim".into()));
        assert_eq!(interrupt(&mut shown), Some(0));
    }
}

#[test]
fn pictures_that_do_not_exist_are_refused_before_any_window_opens() {
    let xvfb = Xvfb::start(320, 240);
    for (name, said) in [("grey", "grey"), ("column-30", "no mode shows")] {
        let output = program(&xvfb, &["show", name]).output().expect("the program");
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(65), "{text}");
        assert!(text.contains(said), "{text}");
    }
}

#[test]
fn displays_are_listed_with_their_modes() {
    let xvfb = Xvfb::start(801, 603);
    let output = program(&xvfb, &["devices"]).output().expect("the program");
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{text}");
    let wanted = "projector: display without EDID 801x603 screen (driver window): usable";
    assert!(text.lines().any(|line| line == wanted), "{text}");
}

#[test]
fn where_no_display_can_be_looked_for_that_is_what_is_listed() {
    let mut xvfb = Xvfb::start(320, 240);
    let mut command = program(&xvfb, &["devices"]);
    xvfb.kill();
    let output = command.output().expect("the program");
    let text = String::from_utf8_lossy(&output.stdout);
    assert_eq!(output.status.code(), Some(0), "{text}");
    let wanted = format!("no connection to the X server at `{}`", xvfb.display());
    assert!(text.contains("(driver window)") && text.contains(&wanted), "{text}");
}

#[test]
fn nobody_but_the_service_starts_the_window() {
    let mut command = Command::new(PROGRAM);
    command.arg("projector").stdin(Stdio::null());
    let output = command.output().expect("the program");
    assert_eq!(output.status.code(), Some(69));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(text.contains("give it --listen SOCKET"), "{text}");
}

#[test]
fn the_doctor_says_what_the_window_found() {
    let xvfb = Xvfb::start(320, 240);
    let output = program(&xvfb, &["doctor", "--json"]).output().expect("the program");
    let said: serde_json::Value = serde_json::from_slice(&output.stdout).expect("one object on stdout");
    let of = |check: &str| -> Vec<&serde_json::Value> {
        said["findings"]
            .as_array()
            .expect("findings")
            .iter()
            .filter(|found| found["check"] == check)
            .collect()
    };
    assert_eq!(of("projector")[0]["level"], "ok", "{said:#}");
    // A screen without a display tells no flips.
    let display = of("display");
    let guessed = |found: &&serde_json::Value| {
        found["message"].as_str().is_some_and(|text| text.contains("only guessed"))
    };
    assert!(display.iter().any(|found| found["level"] == "warning" && guessed(found)), "{said:#}");
    assert_eq!(of("camera")[0]["level"], "bad", "{said:#}");
    assert_eq!(output.status.code(), Some(1));
    eventually("the window is gone", || xvfb.screen().iter().all(|byte| *byte == 0));
}
