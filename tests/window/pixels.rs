//! What is on the screen is what the code says, from the moment of the receipt on.

use std::{sync::Arc, time::Duration};

use polscan::sequencer::slide;
use polscan_drivers::{
    error::DeviceError,
    projector::{ProjectorDriver, ReceiptMethod, Slide},
    window::{WindowOptions, WindowProjectors},
};
use polscan_patterns::{ChannelSet, Mode, Picture, Polarization, ProjectorSize, Raster, Sequence};

use crate::{
    clock, open, options, try_open, uniform,
    xvfb::{Xvfb, cover_a_corner, manage},
};

/// Green is horizontal; red and blue are vertical.
const POLARIZATION: Polarization = Polarization {
    horizontal: ChannelSet { red: false, green: true, blue: false },
    vertical: ChannelSet { red: true, green: false, blue: true },
};

fn every_picture(size: ProjectorSize) -> Vec<(String, Raster)> {
    let mut pictures = Vec::new();
    for mode in Mode::ALL {
        let sequence = Sequence::new(mode, size).expect("a sequence");
        let of = |role| (format!("{role} of {mode}"), sequence.raster(role, POLARIZATION));
        pictures.extend(sequence.roles.iter().map(|role| of(*role)));
    }
    pictures.extend(Picture::ALL.map(|picture| (picture.to_string(), picture.raster(size, POLARIZATION))));
    pictures
}

fn comes_out(width: u32, height: u32) {
    let xvfb = Xvfb::start(width, height);
    let size = ProjectorSize { width, height };
    let pictures = every_picture(size);
    assert!(pictures.len() > 100, "{} pictures", pictures.len());
    let mut projector = open(&xvfb);
    assert_eq!((projector.info().width, projector.info().height), (width, height));
    let slides: Vec<Slide> = pictures.iter().map(|(_, raster)| slide(raster.clone())).collect();
    projector.load(&slides).expect("slides");
    let mut previous = None;
    for (number, (name, raster)) in (0..).zip(&pictures) {
        projector.show(number).unwrap_or_else(|error| panic!("{name}: {error}"));
        let screen = xvfb.screen();
        let wanted = raster.to_rgb(size);
        let wrong = screen.iter().zip(&wanted).filter(|(is, wanted)| is != wanted).count();
        assert_eq!((screen.len(), wrong), (wanted.len(), 0), "{name}: bytes that differ");
        if previous.as_ref() != Some(&wanted) {
            projector.black().expect("black");
            assert!(xvfb.screen().iter().all(|byte| *byte == 0), "black after {name}");
        }
        previous = Some(wanted);
    }
}

#[test]
fn every_pattern_comes_out_byte_for_byte() {
    comes_out(1024, 768);
}

#[test]
fn every_pattern_comes_out_on_a_display_of_odd_size() {
    comes_out(801, 603);
}

#[test]
fn every_code_value_comes_out_as_it_is() {
    let xvfb = Xvfb::start(256, 64);
    let mut projector = open(&xvfb);
    let ramp = |channel: usize| -> Slide {
        let value = |code: u8| {
            let mut value = [0; 3];
            value[channel] = code;
            value
        };
        Slide::Columns((0..=255).map(value).collect())
    };
    let all = Slide::Full((0..256 * 64).map(|at| [at as u8, (at / 7) as u8, (at / 64) as u8]).collect());
    let slides = [ramp(0), ramp(1), ramp(2), all];
    projector.load(&slides).expect("slides");
    for (number, slide) in (0..).zip(&slides) {
        projector.show(number).expect("a picture");
        let wanted: Vec<u8> = match slide {
            Slide::Columns(values) => values.as_flattened().repeat(64),
            Slide::Full(values) => values.as_flattened().to_vec(),
            _ => panic!("made above"),
        };
        assert!(xvfb.screen() == wanted, "slide {number}");
    }
}

#[test]
fn receipts_say_that_they_are_guessed_and_come_no_faster_than_the_display() {
    let xvfb = Xvfb::start(320, 240);
    let clock = clock();
    let driver = WindowProjectors::new(options(&xvfb), clock.clone());
    let mut projector = driver.open(Some("screen")).expect("a window");
    let info = projector.info().clone();
    assert_eq!((info.driver.as_str(), info.serial.as_str(), info.timing), ("window", "screen", None));
    let display = info.display.expect("a display");
    assert_eq!(display.receipts, ReceiptMethod::Guessed);
    assert_eq!(display.format, "Bgra8Unorm");
    assert!(display.adapter.contains("llvmpipe"), "{}", display.adapter);
    let [refresh, guessed] = &display.findings[..] else { panic!("{:?}", display.findings) };
    assert_eq!(refresh, "screen does not tell its refresh rate; 60 Hz is assumed");
    assert!(guessed.starts_with("times of flips are only guessed: "), "{guessed}");
    projector.load(&[Slide::Uniform([255; 3]), Slide::Uniform([0, 255, 0])]).expect("slides");
    let began = clock.now();
    let mut last = began;
    for round in 0..30 {
        let asked = clock.now();
        let receipt = projector.show(round % 2).expect("a picture");
        assert_eq!((receipt.slide, receipt.refresh), (Some(round % 2), None));
        assert_eq!(receipt.method, ReceiptMethod::Guessed);
        assert!(asked <= receipt.flipped && receipt.flipped <= clock.now(), "{asked} {}", receipt.flipped);
        assert!(last < receipt.flipped);
        last = receipt.flipped;
    }
    assert!(last.since(began) >= info.refresh_period * 28, "30 pictures in {:?}", last.since(began));
    assert_eq!(info.refresh_period, Duration::from_nanos(16_666_667));
}

#[test]
fn a_display_of_another_size_is_refused_with_both_sizes() {
    let xvfb = Xvfb::start(320, 240);
    let refused = try_open(WindowOptions { size: Some([1024, 768]), ..options(&xvfb) });
    let Err(DeviceError::Refused { setting, requested, offered, .. }) = refused.map(|_| ()) else {
        panic!("it was not refused");
    };
    assert_eq!(setting, "display mode (columns x rows)");
    assert_eq!((requested.as_str(), offered.as_str()), ("1024 x 768", "320 x 240 on screen"));
    let right = WindowOptions { size: Some([320, 240]), refresh_hz: Some(50.0), ..options(&xvfb) };
    assert_eq!(try_open(right).expect("a window").info().refresh_period, Duration::from_millis(20));
}

#[test]
fn a_display_that_is_not_there_is_named_with_those_that_are() {
    let xvfb = Xvfb::start(320, 240);
    let driver = WindowProjectors::new(options(&xvfb), clock());
    let error = driver.open(Some("HDMI-1")).map(|_| ()).expect_err("there is none");
    assert_eq!(error.to_string(), "HDMI-1: there is none; the displays are screen");
}

#[test]
fn slides_that_do_not_fit_are_refused_and_those_before_stay() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let early = projector.show(0).expect_err("nothing is loaded");
    assert!(matches!(early, DeviceError::OutOfOrder { .. }), "{early}");
    let (slide, screen) = uniform(&xvfb, [7, 8, 9]);
    projector.load(&[slide]).expect("a slide");
    let long = Slide::Columns(Arc::from(vec![[0; 3]; 321]));
    let refused = projector.load(&[Slide::Uniform([0; 3]), long]).expect_err("a column too many");
    assert!(refused.to_string().contains("321 columns in slide 1"), "{refused}");
    let missing = projector.show(1).expect_err("there is one slide");
    assert!(missing.to_string().contains("asked 1, has 1 slides"), "{missing}");
    projector.show(0).expect("the slide from before");
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_window_that_covers_the_patterns_is_noticed() {
    let xvfb = Xvfb::start(320, 240);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [1, 2, 3]);
    projector.load(&[slide]).expect("a slide");
    let other = cover_a_corner(&xvfb);
    let error = projector.show(0).expect_err("its corner is covered");
    assert!(error.to_string().contains("another window covers part"), "{error}");
    drop(other);
    crate::xvfb::eventually("the window is gone", || projector.show(0).is_ok());
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_window_manager_makes_it_full_screen() {
    let xvfb = Xvfb::start(320, 240);
    manage(&xvfb, false);
    let mut projector = open(&xvfb);
    let (slide, screen) = uniform(&xvfb, [40, 50, 60]);
    projector.load(&[slide]).expect("a slide");
    projector.show(0).expect("a picture");
    assert!(xvfb.screen() == screen);
}

#[test]
fn a_window_manager_that_keeps_it_small_is_refused() {
    let xvfb = Xvfb::start(320, 240);
    manage(&xvfb, true);
    let refused = try_open(options(&xvfb)).map(|_| ()).expect_err("the window is small");
    let text = "asked a window at 320x240+0+0, has one at 160x120+20+10";
    assert!(
        refused.to_string().contains("one pixel per pixel") && refused.to_string().contains(text),
        "{refused}"
    );
}
