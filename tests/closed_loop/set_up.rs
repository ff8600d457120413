//! Aiming and focusing: a picture is held by the real window while nothing is scanned.

use polscan_patterns::{ChannelSet, Picture, Polarization, ProjectorSize};
use serde_json::{Value, json};

use crate::{rig::Rig, stage::Stage};

const POLARIZATION: Polarization = Polarization {
    horizontal: ChannelSet { red: false, green: true, blue: false },
    vertical: ChannelSet { red: true, green: false, blue: true },
};

#[test]
fn pictures_are_held_by_the_window_but_not_while_a_scan_runs() {
    let stage = Stage::new(Rig::small(), 20.0);
    let daemon = stage.daemon(Rig::small());
    daemon.ready();
    let size = ProjectorSize { width: 256, height: 192 };
    let put = |name: &str| daemon.request("PUT", "/v1/projector", &json!({ "show": name }));
    let showing = || daemon.get("/v1/status").expect(200).json()["showing"].clone();
    for picture in [Picture::H, Picture::V, Picture::Focus, Picture::Checker, Picture::Black] {
        put(picture.name()).expect(200);
        assert!(stage.xvfb.screen() == picture.raster(size, POLARIZATION).to_rgb(size), "{picture}");
        let held = if picture == Picture::Black { Value::Null } else { picture.name().into() };
        assert_eq!(showing(), held);
    }

    put("h").expect(200);
    let id = daemon.scan(&json!({ "mode": "fast" }));
    daemon.until(&id, |scan| scan["progress"]["frames"].as_u64() > Some(0));
    let refused = put("white").expect(409).json();
    assert_eq!(refused["holder"]["id"], id.as_str(), "{refused}");
    assert_eq!(showing(), Value::Null);
    assert_eq!(daemon.done(&id)["state"], "done");
    // A scan leaves black behind, and the picture for set-up does not come back by itself.
    assert!(stage.xvfb.screen().iter().all(|byte| *byte == 0));
    put("h").expect(200);
    assert!(stage.xvfb.screen() == Picture::H.raster(size, POLARIZATION).to_rgb(size));
}

#[test]
fn a_pattern_that_this_projector_cannot_show_is_refused_and_the_status_does_not_say_otherwise() {
    let stage = Stage::new(Rig::small(), 20.0);
    let daemon = stage.daemon(Rig::small());
    daemon.ready();
    let put = |name: &str| daemon.request("PUT", "/v1/projector", &json!({ "show": name }));
    put("white").expect(200);
    let refused = put("column-30");
    assert!(refused.status >= 400, "{refused:?}");
    let status = daemon.get("/v1/status").json();
    assert_eq!((&status["showing"], &status["rig"]), (&"white".into(), &"ready".into()), "{status}");
}
