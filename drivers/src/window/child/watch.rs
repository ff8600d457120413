//! The window seen from a second connection to the X server: where it is, what covers it, and when its pictures came
//! to the glass. The first connection belongs to the window itself and to the GPU's driver.

use std::time::{Duration, Instant};

use x11rb::{
    connection::{Connection, RequestConnection},
    protocol::{
        Event,
        damage::{self, ConnectionExt as _, ReportLevel},
        dpms::{self, ConnectionExt as _, DPMSMode},
        present::{self, CompleteKind, CompleteMode, ConnectionExt as _},
        randr::{ConnectionExt as _, NotifyMask},
        screensaver::{self, ConnectionExt as _},
        xproto::{
            AtomEnum, Blanking, ChangeWindowAttributesAux, ConfigureWindowAux, ConnectionExt as _, EventMask,
            Exposures, MapState, StackMode, Visibility, Window,
        },
    },
    rust_connection::RustConnection,
};

use crate::window::{
    displays::{self, Display, Place, ask},
    protocol::{Fault, Want},
};

/// Pause between two looks for events.
const LOOK: Duration = Duration::from_micros(300);

/// What the X server told about a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// The Present extension completed it.
    Completed {
        /// Number of the refresh.
        msc: u64,
        /// When, in microseconds of the monotonic clock.
        ust: u64,
        /// Whether the picture itself went to the glass (flip), rather than a copy of it or nothing at all.
        how: How,
    },
    /// The server has drawn all of it into the window.
    Drawn,
}

/// How a picture was completed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum How {
    /// Scan-out was switched to it.
    Flip,
    /// It was copied, to the screen or to where a compositor takes it from.
    Copy,
    /// Another picture came before it was shown.
    Skip,
}

/// The second connection.
pub struct Watch {
    x: RustConnection,
    screen: usize,
    root: Window,
    window: Option<Window>,
    damage: Option<damage::Damage>,
    /// Pixels drawn since the last [`Watch::forget`].
    drawn: u64,
    obscured: bool,
    changed: bool,
}

impl Watch {
    /// Connects to the X server that `name` or DISPLAY names; there is no window yet.
    pub fn new(name: Option<&str>) -> Result<Self, Fault> {
        let (x, screen, root) = displays::connect(name)?;
        let mask = NotifyMask::SCREEN_CHANGE | NotifyMask::CRTC_CHANGE | NotifyMask::OUTPUT_CHANGE;
        x.randr_select_input(root, mask).map_err(|error| gone(&error))?;
        Ok(Self { x, screen, root, window: None, damage: None, drawn: 0, obscured: false, changed: false })
    }

    /// The display that is asked for, as it is now.
    pub fn choose(&self, want: &Want) -> Result<(Display, Place), Fault> {
        displays::choose(displays::find(&self.x, self.root)?, want)
    }

    /// Whether a window manager runs, which alone can make a window full-screen.
    pub fn has_manager(&self) -> Result<bool, Fault> {
        let name = ask(self.x.intern_atom(true, b"_NET_SUPPORTING_WM_CHECK"), "look for a window manager")?;
        if name.atom == 0 {
            return Ok(false);
        }
        let check = |window| {
            let read = self.x.get_property(false, window, name.atom, AtomEnum::WINDOW, 0, 1).ok()?;
            read.reply().ok()?.value32()?.next()
        };
        // A manager that ended without cleaning up leaves the name of a window that is gone.
        Ok(check(self.root).is_some_and(|window| check(window) == Some(window)))
    }

    /// Why the times of flips cannot be trusted whatever the server says, if something stands between.
    pub fn between(&self) -> Result<Option<String>, Fault> {
        let name = format!("_NET_WM_CM_S{}", self.screen);
        let atom = ask(self.x.intern_atom(false, name.as_bytes()), "look for a compositor")?.atom;
        let owner = ask(self.x.get_selection_owner(atom), "look for a compositor")?.owner;
        if ask(self.x.query_extension(b"XWAYLAND"), "look for Wayland")?.present {
            return Ok(Some(
                "the X server draws into a Wayland compositor, which shows pictures when it likes".into(),
            ));
        }
        Ok((owner != 0).then(|| "a compositor shows pictures when it likes; switch it off".into()))
    }

    /// Keeps the screen lit for as long as this connection lasts.
    pub fn stay_awake(&self) -> Result<(), Fault> {
        let has = |name| self.x.extension_information(name).ok().flatten().is_some();
        if has(screensaver::X11_EXTENSION_NAME) {
            let _ = ask(self.x.screensaver_query_version(1, 1), "keep the screen lit")?;
            self.x.screensaver_suspend(1).map_err(|error| gone(&error))?;
        } else {
            let kept = self.x.set_screen_saver(0, 0, Blanking::NOT_PREFERRED, Exposures::NOT_ALLOWED);
            kept.map_err(|error| gone(&error))?;
        }
        if has(dpms::X11_EXTENSION_NAME) && ask(self.x.dpms_info(), "keep the screen lit")?.state {
            self.x.dpms_force_level(DPMSMode::ON).map_err(|error| gone(&error))?;
        }
        self.x.flush().map_err(|error| gone(&error))
    }

    /// Looks at `window` from now on.
    pub fn follow(&mut self, window: Window) -> Result<(), Fault> {
        let events = ChangeWindowAttributesAux::new().event_mask(EventMask::VISIBILITY_CHANGE);
        self.x.change_window_attributes(window, &events).map_err(|error| gone(&error))?;
        let above = ConfigureWindowAux::new().stack_mode(StackMode::ABOVE);
        self.x.configure_window(window, &above).map_err(|error| gone(&error))?;
        if self.x.extension_information(present::X11_EXTENSION_NAME).ok().flatten().is_some() {
            let _ = ask(self.x.present_query_version(1, 2), "use the Present extension")?;
            let id = self.x.generate_id().map_err(|error| gone(&error))?;
            self.x
                .present_select_input(id, window, present::EventMask::COMPLETE_NOTIFY)
                .map_err(|error| gone(&error))?;
        }
        self.window = Some(window);
        self.x.flush().map_err(|error| gone(&error))
    }

    /// Asks to be told of drawing as well, where completions do not come. Returns whether the server can.
    pub fn watch_drawing(&mut self) -> Result<bool, Fault> {
        let Some(window) = self.window else { return Ok(false) };
        if self.x.extension_information(damage::X11_EXTENSION_NAME).ok().flatten().is_none() {
            return Ok(false);
        }
        let _ = ask(self.x.damage_query_version(1, 1), "use the Damage extension")?;
        let id = self.x.generate_id().map_err(|error| gone(&error))?;
        self.x.damage_create(id, window, ReportLevel::RAW_RECTANGLES).map_err(|error| gone(&error))?;
        self.damage = Some(id);
        self.x.flush().map_err(|error| gone(&error))?;
        Ok(true)
    }

    /// Where `window` is, once it is on the screen.
    pub fn place(&self, window: Window) -> Result<Option<Place>, Fault> {
        let state = ask(self.x.get_window_attributes(window), "look at the window")?.map_state;
        let size = ask(self.x.get_geometry(window), "look at the window")?;
        let corner = ask(self.x.translate_coordinates(window, self.root, 0, 0), "look at the window")?;
        let (width, height) = (size.width.into(), size.height.into());
        let place = Place { x: corner.dst_x.into(), y: corner.dst_y.into(), width, height };
        Ok((state == MapState::VIEWABLE).then_some(place))
    }

    /// Forgets what was drawn so far, all that the server knows of it.
    pub fn forget(&mut self) -> Result<(), Fault> {
        // An answer comes after all events before it: one that is still on its way would count as the next picture.
        let _ = ask(self.x.get_input_focus(), "wait for the X server")?;
        while self.next()?.is_some() {}
        self.drawn = 0;
        Ok(())
    }

    /// What the server tells next about a picture of so many pixels; `None` after `deadline`.
    pub fn wait(&mut self, pixels: u64, deadline: Instant) -> Result<Option<Seen>, Fault> {
        loop {
            match self.next()? {
                Some(Seen::Drawn) if self.drawn < pixels => continue,
                Some(seen) => return Ok(Some(seen)),
                None if Instant::now() >= deadline => return Ok(None),
                None => std::thread::sleep(LOOK),
            }
        }
    }

    /// The next thing told about a picture; events about anything else are taken in on the way.
    fn next(&mut self) -> Result<Option<Seen>, Fault> {
        while let Some(event) = self.x.poll_for_event().map_err(|error| gone(&error))? {
            match event {
                Event::PresentCompleteNotify(event) if event.kind == CompleteKind::PIXMAP => {
                    let how = match event.mode {
                        CompleteMode::FLIP => How::Flip,
                        CompleteMode::SKIP => How::Skip,
                        _ => How::Copy,
                    };
                    return Ok(Some(Seen::Completed { msc: event.msc, ust: event.ust, how }));
                }
                Event::DamageNotify(event) => {
                    self.drawn += u64::from(event.area.width) * u64::from(event.area.height);
                    return Ok(Some(Seen::Drawn));
                }
                Event::VisibilityNotify(event) => self.obscured = event.state != Visibility::UNOBSCURED,
                Event::RandrNotify(_) | Event::RandrScreenChangeNotify(_) => self.changed = true,
                _ => {}
            }
        }
        Ok(None)
    }

    /// Whether another window covers part of this one.
    pub fn is_obscured(&self) -> bool {
        self.obscured
    }

    /// Whether the displays changed since the last time this was asked.
    pub fn take_change(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }
}

fn gone(error: &dyn std::fmt::Display) -> Fault {
    Fault::Unavailable(format!("the X server is gone ({error}); start it again"))
}

#[cfg(test)]
mod tests {
    use std::{
        io::{BufRead, BufReader},
        process::{Child, Command, Stdio},
    };

    use rustix::time::{ClockId, clock_gettime};
    use x11rb::protocol::xproto::{CreateGCAux, CreateWindowAux, ImageFormat, WindowClass};

    use super::*;

    const WIDTH: u16 = 64;
    const HEIGHT: u16 = 48;

    /// An X server whose screen is as large as the window of these tests.
    struct Server(Child, String);

    impl Server {
        fn start() -> Self {
            let size = format!("{WIDTH}x{HEIGHT}x24");
            let mut server = Command::new("Xvfb");
            server.args(["-displayfd", "1", "-nolisten", "tcp", "-screen", "0", &size]);
            let mut server = server.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("Xvfb");
            let mut number = String::new();
            let said = server.stdout.take().expect("its output");
            BufReader::new(said).read_line(&mut number).expect("its number");
            Self(server, format!(":{}", number.trim()))
        }
    }

    impl Drop for Server {
        fn drop(&mut self) {
            let _ = self.0.kill();
            let _ = self.0.wait();
        }
    }

    /// Another client's window, as the GPU's driver is another client.
    fn window(name: &str) -> (RustConnection, Window) {
        let (x, screen) = RustConnection::connect(Some(name)).expect("a server");
        let (root, id) = (x.setup().roots[screen].root, x.generate_id().expect("an id"));
        let attributes = CreateWindowAux::new().override_redirect(1);
        x.create_window(24, id, root, 0, 0, WIDTH, HEIGHT, 0, WindowClass::INPUT_OUTPUT, 0, &attributes)
            .and_then(|_| x.map_window(id))
            .expect("requests")
            .check()
            .expect("a window");
        (x, id)
    }

    const PIXELS: u64 = WIDTH as u64 * HEIGHT as u64;

    fn soon() -> Instant {
        Instant::now() + Duration::from_secs(2)
    }

    #[test]
    fn completions_of_another_client_are_seen_on_the_machines_clock() {
        let server = Server::start();
        let (x, id) = window(&server.1);
        let mut watch = Watch::new(Some(&server.1)).expect("a server");
        watch.follow(id).expect("a window");
        let place = Place { x: 0, y: 0, width: WIDTH.into(), height: HEIGHT.into() };
        assert_eq!(watch.place(id), Ok(Some(place)));
        let pixmap = x.generate_id().expect("an id");
        x.create_pixmap(24, pixmap, id, WIDTH, HEIGHT).expect("a request").check().expect("a pixmap");
        x.present_query_version(1, 2).expect("a request").reply().expect("the extension");
        let mut last = 0;
        for serial in 1..6 {
            watch.forget().expect("a server");
            x.present_pixmap(id, pixmap, serial, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, &[])
                .expect("a request")
                .check()
                .expect("a picture");
            let seen = watch.wait(PIXELS, soon()).expect("a server");
            let Some(Seen::Completed { msc, ust, how }) = seen else { panic!("{seen:?}") };
            // A server without a display cannot switch to a picture.
            assert_eq!(how, How::Copy);
            assert!(msc > last, "refresh {msc} after {last}");
            last = msc;
            let now = clock_gettime(ClockId::Monotonic);
            let now_us = now.tv_sec as u64 * 1_000_000 + now.tv_nsec as u64 / 1000;
            assert!(now_us.abs_diff(ust) < 1_000_000, "{ust} us at {now_us} us");
        }
    }

    #[test]
    fn a_picture_is_drawn_when_all_of_it_is() {
        let server = Server::start();
        let (x, id) = window(&server.1);
        let mut watch = Watch::new(Some(&server.1)).expect("a server");
        watch.follow(id).expect("a window");
        assert_eq!(watch.watch_drawing(), Ok(true));
        let gc = x.generate_id().expect("an id");
        x.create_gc(gc, id, &CreateGCAux::new()).expect("a request").check().expect("a context");
        let rows = |from: u16, rows: u16| {
            let bytes = vec![7; 4 * usize::from(WIDTH) * usize::from(rows)];
            x.put_image(ImageFormat::Z_PIXMAP, id, gc, WIDTH, rows, 0, from as i16, 0, 24, &bytes)
                .expect("a request")
                .check()
                .expect("drawn");
        };
        watch.forget().expect("a server");
        rows(0, 20);
        assert_eq!(watch.wait(PIXELS, Instant::now() + Duration::from_millis(100)), Ok(None));
        rows(20, HEIGHT - 20);
        assert_eq!(watch.wait(PIXELS, soon()), Ok(Some(Seen::Drawn)));
        watch.forget().expect("a server");
        assert_eq!(watch.wait(PIXELS, Instant::now() + Duration::from_millis(50)), Ok(None));
    }

    #[test]
    fn a_server_that_goes_away_is_noticed() {
        let mut server = Server::start();
        let mut watch = Watch::new(Some(&server.1)).expect("a server");
        assert_eq!(watch.has_manager(), Ok(false));
        assert_eq!(watch.between(), Ok(None));
        watch.stay_awake().expect("a server");
        server.0.kill().expect("it runs");
        server.0.wait().expect("it has ended");
        let gone = watch.wait(PIXELS, soon()).expect_err("it has ended");
        assert!(matches!(&gone, Fault::Unavailable(said) if said.contains("X server is gone")), "{gone:?}");
    }
}
