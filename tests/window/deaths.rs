//! X server, window process and display die or hang; what is said of it, and what works afterwards.

use std::{
    fs,
    time::{Duration, Instant},
};

use polscan_drivers::error::DeviceError;
use rustix::process::{Signal, kill_process};

use crate::{
    open, options, try_open, uniform,
    xvfb::{Xvfb, eventually, window_process},
};

#[test]
fn a_window_killed_between_two_pictures_is_named_once_and_opened_again() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [200, 100, 50]);
    projector.load(&[slide]).expect("a slide");
    projector.show(0).expect("a picture");
    let first = window_process(&xvfb);
    kill_process(first, Signal::KILL).expect("it runs");
    // A process that has ended and was not waited for is a zombie of one thread.
    let proc = format!("/proc/{}", first.as_raw_nonzero());
    eventually("it has ended", || {
        let stat = fs::read_to_string(format!("{proc}/stat")).expect("its state");
        stat.contains(") Z ") && fs::read_dir(format!("{proc}/task")).expect("its threads").count() == 1
    });
    // The picture has been gone for some time, in which somebody may have looked at it.
    let error = projector.alive().expect_err("it is gone");
    assert_eq!(projector.show(0).expect_err("it is gone").to_string(), error.to_string());
    let text = error.to_string();
    assert!(text.contains("ended while nothing was asked of it") && text.contains("signal: 9"), "{text}");
    projector.show(0).expect("a picture of a new process");
    projector.alive().expect("the new process");
    let second = window_process(&xvfb);
    assert_ne!(second, first);
    assert!(xvfb.screen() == screen);
    let process = projector.info().display.as_ref().and_then(|display| display.process).expect("a process");
    assert_eq!((process.pid, process.restarts), (Some(second.as_raw_nonzero().get() as u32), 1));
}

#[test]
fn a_window_killed_before_a_set_of_pictures_matters_to_nobody() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [20, 10, 5]);
    let first = window_process(&xvfb);
    kill_process(first, Signal::KILL).expect("it runs");
    eventually("it has ended", || projector.alive().is_err());
    projector.load(&[slide]).expect("a slide");
    projector.show(0).expect("a picture of a new process");
    assert_ne!(window_process(&xvfb), first);
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_window_that_hangs_is_late_then_ended_and_replaced() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [9, 99, 199]);
    projector.load(&[slide]).expect("a slide");
    let first = window_process(&xvfb);
    kill_process(first, Signal::STOP).expect("it runs");
    let began = Instant::now();
    let error = projector.show(0).expect_err("it hangs");
    let DeviceError::Timeout { timeout_ms, .. } = error else { panic!("{error}") };
    assert_eq!(timeout_ms, 2000);
    assert!(began.elapsed() < Duration::from_secs(4), "{:?}", began.elapsed());
    projector.show(0).expect("a picture of a new process");
    assert_ne!(window_process(&xvfb), first);
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_window_killed_at_work_is_named() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [9, 99, 199]);
    projector.load(&[slide]).expect("a slide");
    let first = window_process(&xvfb);
    // Stopped, so that it certainly has the request and certainly has not answered.
    kill_process(first, Signal::STOP).expect("it runs");
    let killer = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(300));
        kill_process(first, Signal::KILL).expect("it hangs");
    });
    let error = projector.show(0).expect_err("it is killed");
    killer.join().expect("the killer");
    assert!(matches!(error, DeviceError::Unavailable { .. }), "{error}");
    let text = error.to_string();
    assert!(text.contains("the process with its window is gone") && text.contains("signal: 9"), "{text}");
    projector.show(0).expect("a picture of a new process");
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_display_server_that_dies_is_named_and_its_successor_used() {
    let mut xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [50, 60, 70]);
    projector.load(&[slide]).expect("a slide");
    projector.show(0).expect("a picture");
    xvfb.kill();
    let began = Instant::now();
    let error = projector.show(0).expect_err("there is no display any more");
    assert!(matches!(error, DeviceError::Unavailable { .. }), "{error}");
    assert!(
        error.to_string().contains("X server") || error.to_string().contains("window is gone"),
        "{error}"
    );
    assert!(began.elapsed() < Duration::from_secs(5), "{:?}", began.elapsed());
    let error = projector.black().expect_err("nor later");
    assert!(error.to_string().contains("X server"), "{error}");
    let again = Xvfb::start_at(xvfb.number, 320, 240);
    eventually("the window is open again", || projector.show(0).is_ok());
    assert!(again.screen() == screen);
}

#[test]
fn a_display_of_another_size_is_not_the_same_display() {
    let mut xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    projector.black().expect("black");
    xvfb.kill();
    let smaller = Xvfb::start_at(xvfb.number, 300, 200);
    eventually("it is opened again", || {
        let error = projector.black().expect_err("another display");
        let changed =
            error.to_string().contains("asked screen with 320 x 240 at 60.00 Hz, has screen with 300 x 200");
        assert!(changed || matches!(error, DeviceError::Unavailable { .. }), "{error}");
        changed
    });
    drop(smaller);
}

#[test]
fn without_a_display_server_it_is_said_what_to_start() {
    let mut xvfb = Xvfb::start(320, 240);
    let options = options(&xvfb);
    xvfb.kill();
    let began = Instant::now();
    let error = try_open(options).map(|_| ()).expect_err("there is no display");
    assert!(
        error.to_string().contains(&format!("no connection to the X server at `{}`", xvfb.display())),
        "{error}"
    );
    assert!(began.elapsed() < Duration::from_secs(5), "{:?}", began.elapsed());
}
