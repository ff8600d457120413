//! A window of the seat's session, which the service reaches by a socket.

use std::{
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
};

use polscan_drivers::{
    projector::ProjectorDriver,
    window::{WindowOptions, WindowProjectors},
};

use crate::{
    PROGRAM, clock, try_open, uniform,
    xvfb::{Xvfb, eventually},
};

/// `polscan projector --listen`, ended with the test.
struct Seat(Child);

impl Seat {
    fn start(xvfb: &Xvfb, socket: &Path) -> Self {
        let mut command = Command::new(PROGRAM);
        command.args(["projector", "--listen"]).arg(socket).env("DISPLAY", xvfb.display());
        command.stdin(Stdio::null()).stderr(Stdio::null());
        let seat = Self(command.spawn().expect("the program"));
        eventually("it listens", || socket.exists());
        seat
    }
}

impl Drop for Seat {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn at(socket: &Path) -> WindowOptions {
    WindowOptions { socket: Some(socket.to_owned()), program: PathBuf::new(), ..WindowOptions::default() }
}

#[test]
fn one_client_at_a_time_has_the_window_and_leaves_black_behind() {
    let folder = tempfile::tempdir().expect("a folder");
    let socket = folder.path().join("projector.sock");
    let xvfb = Xvfb::start(320, 240);
    let _seat = Seat::start(&xvfb, &socket);
    let mut first = try_open(at(&socket)).expect("a window");
    let (slide, screen) = uniform(&xvfb, [10, 20, 30]);
    first.load(std::slice::from_ref(&slide)).expect("a slide");
    first.show(0).expect("a picture");
    assert!(xvfb.screen() == screen);

    let error = try_open(at(&socket)).map(|_| ()).expect_err("the window is taken");
    assert!(error.to_string().contains("another program has the projector's window"), "{error}");
    let listed = WindowProjectors::new(at(&socket), clock()).list().expect("displays");
    assert_eq!(listed.len(), 1);
    assert_eq!((listed[0].serial.as_str(), &listed[0].unusable), ("screen", &None));
    assert!(listed[0].model.contains("320x240"), "{}", listed[0].model);
    first.show(0).expect("a picture, undisturbed");

    drop(first);
    eventually("black is left behind", || xvfb.screen().iter().all(|byte| *byte == 0));
    let mut second = try_open(at(&socket)).expect("the same window");
    second.load(&[slide]).expect("a slide");
    second.show(0).expect("a picture");
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_seat_that_comes_back_is_found_again() {
    let folder = tempfile::tempdir().expect("a folder");
    let socket = folder.path().join("projector.sock");
    let error = try_open(at(&socket)).map(|_| ()).expect_err("nobody listens");
    assert!(
        error.to_string().contains("start `polscan projector --listen` in the seat's session"),
        "{error}"
    );
    let xvfb = Xvfb::start(320, 240);
    let seat = Seat::start(&xvfb, &socket);
    let mut projector = try_open(at(&socket)).expect("a window");
    let (slide, screen) = uniform(&xvfb, [10, 20, 30]);
    projector.load(&[slide]).expect("a slide");
    // Killed, so that its socket stays behind.
    drop(seat);
    assert!(socket.exists());
    assert!(projector.show(0).is_err());
    let _seat = Seat::start(&xvfb, &socket);
    eventually("the window is open again", || projector.show(0).is_ok());
    assert!(xvfb.screen() == screen);
}
