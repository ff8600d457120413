//! Displays of an X server, and the one that was asked for.

use x11rb::{
    connection::Connection,
    protocol::{
        randr::{Connection as Link, ConnectionExt as _, Crtc, ModeFlag, ModeInfo, Output, Rotation},
        render::Transform,
        xproto::{AtomEnum, ConnectionExt as _, Window},
    },
    rust_connection::RustConnection,
};

use super::{
    edid::{self, Identity},
    protocol::{Asked, DisplayLine, Fault, Want},
};

/// A fixed-point 1.0 of the render extension.
const ONE: i32 = 1 << 16;

/// How far the refresh of a mode may be from what is asked for: 59.94 Hz is not 60 Hz, rounding is no difference.
const REFRESH_TOLERANCE: f64 = 5e-4;

/// Rectangle on the screen in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    /// First column.
    pub x: i32,
    /// First row.
    pub y: i32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Place {
    /// Pixels in it.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }
}

/// A display.
#[derive(Debug, Clone, PartialEq)]
pub struct Display {
    /// Connector.
    pub connector: String,
    /// What it says of itself.
    pub identity: Identity,
    /// Where it is on the screen, while it is on.
    pub place: Option<Place>,
    /// Refreshes per second, where the mode tells.
    pub refresh_hz: Option<f64>,
    /// Why it cannot be used and what to do.
    pub unusable: Option<String>,
    /// What bends code values on their way.
    pub findings: Vec<String>,
}

impl Display {
    /// Maker and name.
    pub fn model(&self) -> String {
        let name = format!("{} {}", self.identity.maker, self.identity.name);
        if name.trim().is_empty() { "display without EDID".to_owned() } else { name.trim().to_owned() }
    }

    /// The display as it is listed.
    pub fn line(&self) -> DisplayLine {
        let size = self.place.map(|place| format!(" {}x{}", place.width, place.height)).unwrap_or_default();
        let refresh = self.refresh_hz.map(|hz| format!(" at {hz:.2} Hz")).unwrap_or_default();
        DisplayLine {
            connector: self.connector.clone(),
            model: format!("{}{size}{refresh}", self.model()),
            unusable: self.unusable.clone().unwrap_or_default(),
        }
    }
}

/// The display that is asked for, if it is as it is asked for.
pub fn choose(displays: Vec<Display>, want: &Want) -> Result<(Display, Place), Fault> {
    let named = |display: &Display| {
        let names = [&display.connector, &display.identity.name, &display.identity.serial];
        names.into_iter().any(|name| !name.is_empty() && *name == want.display)
    };
    let all: Vec<String> = displays.iter().map(|display| display.connector.clone()).collect();
    let fits = |display: &Display| {
        if want.display.is_empty() { display.unusable.is_none() } else { named(display) }
    };
    let (fitting, others): (Vec<_>, Vec<_>) = displays.into_iter().partition(fits);
    let [display] = <[Display; 1]>::try_from(fitting).map_err(|fitting| {
        let reasons: Vec<_> = others.iter().filter_map(|display| display.unusable.as_deref()).collect();
        let detail = match (fitting.len(), want.display.is_empty()) {
            (0, true) if all.is_empty() => "the X server has no display".to_owned(),
            (0, true) => format!("no display can be used: {}", reasons.join("; ")),
            (0, false) => format!("there is none; the displays are {}", all.join(", ")),
            _ => format!("there are several; name one of {} in projector.serial", all.join(", ")),
        };
        Fault::Unavailable(detail)
    })?;
    if let Some(reason) = display.unusable {
        return Err(Fault::Unavailable(reason));
    }
    let place = display.place.ok_or_else(|| Fault::Unavailable(format!("{} is off", display.connector)))?;
    if let Some((width, height)) = want.size
        && (width, height) != (place.width, place.height)
    {
        return Err(Fault::Refused {
            what: Asked::Size,
            requested: format!("{width} x {height}"),
            offered: format!("{} x {} on {}", place.width, place.height, display.connector),
        });
    }
    if let (Some(asked), Some(has)) = (want.refresh_hz, display.refresh_hz)
        && (has / asked - 1.0).abs() > REFRESH_TOLERANCE
    {
        return Err(Fault::Refused {
            what: Asked::Refresh,
            requested: format!("{asked:.3}"),
            offered: format!("{has:.3} on {}", display.connector),
        });
    }
    Ok((display, place))
}

/// All displays of a screen, in the server's order.
pub fn find(x: &RustConnection, root: Window) -> Result<Vec<Display>, Fault> {
    let resources = ask(x.randr_get_screen_resources_current(root), "list displays")?;
    let mut found = Vec::new();
    let mut lit: Vec<(Crtc, String)> = Vec::new();
    for output in resources.outputs {
        let info = ask(x.randr_get_output_info(output, resources.config_timestamp), "describe a display")?;
        let connector = String::from_utf8_lossy(&info.name).into_owned();
        let identity = edid::identity(&property(x, output, "EDID")?).unwrap_or_default();
        let mut display = Display {
            connector: connector.clone(),
            identity,
            place: None,
            refresh_hz: None,
            unusable: None,
            findings: Vec::new(),
        };
        if info.crtc == 0 {
            display.unusable = Some(match info.connection {
                Link::DISCONNECTED => format!("nothing is connected to {connector}, or it is switched off"),
                _ => format!("{connector} is off; switch it on with `xrandr --output {connector} --auto`"),
            });
        } else {
            if let Some((_, other)) = lit.iter().find(|(crtc, _)| *crtc == info.crtc) {
                display.findings.push(format!("{connector} shows the same as {other}"));
            }
            lit.push((info.crtc, connector));
            look(x, &mut display, info.crtc, resources.config_timestamp, &resources.modes)?;
            if info.connection == Link::DISCONNECTED {
                let connector = &display.connector;
                display.unusable =
                    Some(format!("nothing is connected to {connector} any more, or it is switched off"));
            }
            code_values(x, &mut display, output, info.crtc)?;
        }
        found.push(display);
    }
    Ok(found)
}

/// Mode and place of a display that is on.
fn look(
    x: &RustConnection,
    display: &mut Display,
    crtc: Crtc,
    stamp: u32,
    modes: &[ModeInfo],
) -> Result<(), Fault> {
    let info = ask(x.randr_get_crtc_info(crtc, stamp), "describe a mode")?;
    let mode = modes.iter().find(|mode| mode.id == info.mode);
    display.refresh_hz = mode.and_then(refresh_hz);
    display.place = Some(Place {
        x: info.x.into(),
        y: info.y.into(),
        width: info.width.into(),
        height: info.height.into(),
    });
    let connector = &display.connector;
    if info.rotation != Rotation::ROTATE0 {
        let next = format!("`xrandr --output {connector} --rotate normal --reflect normal`");
        display.unusable = Some(format!("{connector} is rotated or mirrored; undo it with {next}"));
    }
    // A server without transforms has none to undo.
    let transform = x.randr_get_crtc_transform(crtc).ok().and_then(|cookie| cookie.reply().ok());
    let identity = |t: &Transform| {
        [
            t.matrix11, t.matrix12, t.matrix13, t.matrix21, t.matrix22, t.matrix23, t.matrix31, t.matrix32,
            t.matrix33,
        ] == [ONE, 0, 0, 0, ONE, 0, 0, 0, ONE]
    };
    let scaled = transform.is_some_and(|reply| !identity(&reply.current_transform));
    if scaled || mode.is_some_and(|mode| (mode.width, mode.height) != (info.width, info.height)) {
        let next = format!("`xrandr --output {connector} --scale 1x1`");
        display.unusable.get_or_insert_with(|| format!("{connector} is scaled; undo it with {next}"));
    }
    Ok(())
}

/// Refreshes per second of a mode; a server without hardware states none.
fn refresh_hz(mode: &ModeInfo) -> Option<f64> {
    let flag = |flag: ModeFlag| u32::from(mode.mode_flags) & u32::from(flag) != 0;
    let mut lines = f64::from(mode.vtotal);
    if flag(ModeFlag::DOUBLE_SCAN) {
        lines *= 2.0;
    }
    if flag(ModeFlag::INTERLACE) {
        lines /= 2.0;
    }
    let dots = f64::from(mode.htotal) * lines;
    (mode.dot_clock > 0 && dots > 0.0).then(|| f64::from(mode.dot_clock) / dots)
}

/// Finds what would change code values between the surface and the cable.
fn code_values(x: &RustConnection, display: &mut Display, output: Output, crtc: Crtc) -> Result<(), Fault> {
    // A server without hardware has a table of whatever was in its memory; its modes have no clock either.
    let tables = display.refresh_hz.and_then(|_| x.randr_get_crtc_gamma(crtc).ok());
    let gamma = tables.and_then(|cookie| cookie.reply().ok());
    if gamma
        .is_some_and(|gamma| ![&gamma.red, &gamma.green, &gamma.blue].into_iter().all(|ramp| is_linear(ramp)))
    {
        let next = format!("`xrandr --output {} --gamma 1:1:1 --brightness 1`", display.connector);
        display.findings.push(format!("a gamma table or night light bends code values; undo it with {next}"));
    }
    if is_mixed(&property(x, output, "CTM")?) {
        display
            .findings
            .push(format!("a colour matrix (CTM) of {} mixes channels; reset it", display.connector));
    }
    let range = property(x, output, "Broadcast RGB")?;
    if let Some(atom) = range.first_chunk::<4>().map(|bytes| u32::from_ne_bytes(*bytes))
        && atom != 0
    {
        let name = ask(x.get_atom_name(atom), "read a property")?.name;
        if name.starts_with(b"Limited") {
            let next = format!("`xrandr --output {} --set \"Broadcast RGB\" Full`", display.connector);
            display
                .findings
                .push(format!("the range of code values is limited to 16 to 235; undo it with {next}"));
        }
    }
    Ok(())
}

/// Whether a gamma table passes on what it gets, to the accuracy of 8-bit code values. An empty one does.
fn is_linear(ramp: &[u16]) -> bool {
    let last = ramp.len().saturating_sub(1).max(1) as f64;
    let wanted = (0..ramp.len()).map(|at| 65_535.0 * at as f64 / last);
    ramp.iter().zip(wanted).all(|(has, wanted)| (f64::from(*has) - wanted).abs() <= 128.0)
}

/// Whether a colour matrix is any but the identity: nine numbers with 32 bits after the point, low word first, each word
/// of the width that the server keeps it in. One of zeros was never set.
fn is_mixed(matrix: &[u8]) -> bool {
    let (words, _) = matrix.as_chunks::<4>();
    let numbers: Vec<u64> = words
        .chunks_exact(2)
        .map(|pair| u64::from(u32::from_ne_bytes(pair[1])) << 32 | u64::from(u32::from_ne_bytes(pair[0])))
        .collect();
    const ONE: u64 = 1 << 32;
    numbers.iter().any(|number| *number != 0) && numbers != [ONE, 0, 0, 0, ONE, 0, 0, 0, ONE]
}

/// Bytes of an output's property; empty where it has none of that name.
fn property(x: &RustConnection, output: Output, name: &str) -> Result<Vec<u8>, Fault> {
    let atom = ask(x.intern_atom(true, name.as_bytes()), "read a property")?.atom;
    if atom == 0 {
        return Ok(Vec::new());
    }
    let reply = x.randr_get_output_property(output, atom, AtomEnum::ANY, 0, 128, false, false);
    // An output without that property is an error of some servers.
    Ok(reply.ok().and_then(|cookie| cookie.reply().ok()).map(|reply| reply.data).unwrap_or_default())
}

/// The answer to a request, or what was asked and why there is none.
pub fn ask<R: x11rb::x11_utils::TryParse>(
    asked: Result<x11rb::cookie::Cookie<'_, RustConnection, R>, x11rb::errors::ConnectionError>,
    what: &str,
) -> Result<R, Fault> {
    let gone = |error: &dyn std::fmt::Display| {
        Fault::Unavailable(format!("the X server did not let us {what}: {error}"))
    };
    asked.map_err(|error| gone(&error))?.reply().map_err(|error| gone(&error))
}

/// All displays of the X server that `name` or DISPLAY names, as they are listed.
pub fn list(name: Option<&str>) -> Result<Vec<DisplayLine>, Fault> {
    let (x, _, root) = connect(name)?;
    Ok(find(&x, root)?.iter().map(Display::line).collect())
}

/// A connection to the X server that DISPLAY names, or `name`, and the root window of its screen.
pub fn connect(name: Option<&str>) -> Result<(RustConnection, usize, Window), Fault> {
    let shown = name.map(str::to_owned).or_else(|| std::env::var("DISPLAY").ok()).unwrap_or_default();
    let (x, screen) = RustConnection::connect(name).map_err(|error| {
        let next = "start it, and give the service DISPLAY and XAUTHORITY, or set projector.x11_display";
        Fault::Unavailable(format!("no connection to the X server at `{shown}` ({error}); {next}"))
    })?;
    let root = x.setup().roots[screen].root;
    let version = ask(x.randr_query_version(1, 5), "use RandR")?;
    if (version.major_version, version.minor_version) < (1, 3) {
        return Err(Fault::Unavailable("the X server has no RandR 1.3; it is too old".into()));
    }
    Ok((x, screen, root))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn display(connector: &str, name: &str, serial: &str) -> Display {
        Display {
            connector: connector.into(),
            identity: Identity { maker: "SEC".into(), name: name.into(), serial: serial.into() },
            place: Some(Place { x: 1920, y: 0, width: 1024, height: 768 }),
            refresh_hz: Some(60.004),
            unusable: None,
            findings: Vec::new(),
        }
    }

    fn off(connector: &str) -> Display {
        Display { place: None, unusable: Some(format!("{connector} is off")), ..display(connector, "", "") }
    }

    fn want(display: &str) -> Want {
        Want { display: display.into(), ..Want::default() }
    }

    fn chosen(displays: &[Display], want: &Want) -> Result<String, Fault> {
        choose(displays.to_vec(), want).map(|(display, _)| display.connector)
    }

    #[test]
    fn a_display_is_chosen_by_connector_name_or_serial() {
        let both = [display("DP-1", "EPSON PJ", "X4"), display("HDMI-1", "DELL", "77")];
        for by in ["DP-1", "EPSON PJ", "X4"] {
            assert_eq!(chosen(&both, &want(by)), Ok("DP-1".into()), "{by}");
        }
        assert_eq!(chosen(&both[1..], &want("")), Ok("HDMI-1".into()));
        assert_eq!(chosen(&[off("VGA-1"), both[1].clone()], &want("")), Ok("HDMI-1".into()));
    }

    #[test]
    fn what_cannot_be_chosen_is_said_with_what_there_is() {
        let same = [display("DP-1", "EPSON PJ", "X4"), display("HDMI-1", "EPSON PJ", "X5"), off("VGA-1")];
        let said = |want: &Want| match chosen(&same, want) {
            Err(Fault::Unavailable(said)) => said,
            other => panic!("{other:?}"),
        };
        assert_eq!(said(&want("DP-2")), "there is none; the displays are DP-1, HDMI-1, VGA-1");
        assert!(said(&want("EPSON PJ")).starts_with("there are several; name one of DP-1, HDMI-1"));
        assert!(said(&want("")).starts_with("there are several"));
        assert_eq!(said(&want("VGA-1")), "VGA-1 is off");
        let none = choose(vec![off("VGA-1")], &want("")).expect_err("it is off");
        assert_eq!(none, Fault::Unavailable("no display can be used: VGA-1 is off".into()));
    }

    #[test]
    fn another_size_or_refresh_is_refused_with_both() {
        let one = [display("DP-1", "EPSON PJ", "X4")];
        let size = |width, height| Want { size: Some((width, height)), ..want("") };
        assert!(chosen(&one, &size(1024, 768)).is_ok());
        let refused = |what, requested: &str, offered: &str| {
            Err(Fault::Refused { what, requested: requested.into(), offered: offered.into() })
        };
        assert_eq!(chosen(&one, &size(800, 600)), refused(Asked::Size, "800 x 600", "1024 x 768 on DP-1"));
        let at = |hz| Want { refresh_hz: Some(hz), ..want("") };
        assert!(chosen(&one, &at(60.0)).is_ok());
        assert_eq!(chosen(&one, &at(59.94)), refused(Asked::Refresh, "59.940", "60.004 on DP-1"));
    }

    #[test]
    fn the_refresh_is_that_of_the_whole_picture() {
        // 1024x768 at 60 Hz of VESA DMT: 65 MHz, 1344 x 806.
        let mut mode = ModeInfo { dot_clock: 65_000_000, htotal: 1344, vtotal: 806, ..ModeInfo::default() };
        let hz = refresh_hz(&mode).expect("a rate");
        assert!((hz - 60.004).abs() < 1e-3, "{hz}");
        mode.mode_flags = ModeFlag::INTERLACE;
        assert!((refresh_hz(&mode).expect("a rate") - 2.0 * hz).abs() < 1e-9);
        mode.dot_clock = 0;
        assert_eq!(refresh_hz(&mode), None);
    }

    #[test]
    fn only_a_colour_matrix_that_does_something_is_one() {
        let bytes = |numbers: [u64; 9]| -> Vec<u8> {
            numbers.iter().flat_map(|n| [*n as u32, (*n >> 32) as u32]).flat_map(u32::to_ne_bytes).collect()
        };
        let mut numbers = [0; 9];
        assert!(!is_mixed(&[]) && !is_mixed(&bytes(numbers)));
        for at in [0, 4, 8] {
            numbers[at] = 1 << 32;
        }
        assert!(!is_mixed(&bytes(numbers)));
        numbers[8] = 3 << 30;
        assert!(is_mixed(&bytes(numbers)), "less blue, as night light makes it");
    }

    #[test]
    fn only_a_straight_gamma_table_is_straight() {
        let straight: Vec<u16> = (0..=255).map(|at| at * 257).collect();
        assert!(is_linear(&straight) && is_linear(&[]) && is_linear(&[0]));
        let dimmed: Vec<u16> = straight.iter().map(|value| value / 2).collect();
        let bent: Vec<u16> =
            straight.iter().map(|v| (65_535.0 * (f64::from(*v) / 65_535.0).powf(1.1)) as u16).collect();
        assert!(!is_linear(&dimmed) && !is_linear(&bent));
        let mut stuck = straight;
        stuck[128] = 0;
        assert!(!is_linear(&stuck));
    }
}
