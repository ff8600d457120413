//! An X server without a display, and what is on its screen.

use std::{
    fs,
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use rustix::process::Pid;
use x11rb::{
    connection::Connection,
    errors::ReplyError,
    protocol::{
        Event,
        xproto::{
            AtomEnum, ChangeWindowAttributesAux, ConfigureWindowAux, ConnectionExt as _, CreateWindowAux,
            EventMask, ImageFormat, PropMode, Window, WindowClass,
        },
    },
    rust_connection::RustConnection,
    wrapper::ConnectionExt as _,
};

/// An Xvfb of this test, ended with it.
pub struct Xvfb {
    server: Child,
    /// Number of its display.
    pub number: u32,
}

impl Xvfb {
    /// Starts one on a display that nobody has. It outlives its clients, as one with a session does.
    pub fn start(width: u32, height: u32) -> Self {
        Self::launch(None, width, height)
    }

    /// Starts one on the display of one that has ended.
    pub fn start_at(number: u32, width: u32, height: u32) -> Self {
        Self::launch(Some(number), width, height)
    }

    fn launch(number: Option<u32>, width: u32, height: u32) -> Self {
        let mut command = Command::new("Xvfb");
        command.args(number.map(|number| format!(":{number}"))).arg("-noreset");
        command.args([
            "-displayfd",
            "1",
            "-nolisten",
            "tcp",
            "-screen",
            "0",
            &format!("{width}x{height}x24"),
        ]);
        command.stdout(Stdio::piped()).stderr(Stdio::null());
        let mut server = command.spawn().expect("Xvfb starts; scripts/install test brings it");
        let mut line = String::new();
        let told = server.stdout.take().expect("its output");
        BufReader::new(told).read_line(&mut line).expect("the number of its display");
        let number = line.trim().parse().expect("the number of its display");
        Self { server, number }
    }

    /// Its name in DISPLAY.
    pub fn display(&self) -> String {
        format!(":{}", self.number)
    }

    /// Ends it as a crash does.
    pub fn kill(&mut self) {
        self.server.kill().expect("it runs");
        self.server.wait().expect("it has ended");
    }

    /// A connection to it.
    pub fn connect(&self) -> (RustConnection, Window) {
        let (x, screen) = RustConnection::connect(Some(&self.display())).expect("it answers");
        let root = x.setup().roots[screen].root;
        (x, root)
    }

    /// Everything that is on the screen now, row-major bytes of red, green, blue.
    pub fn screen(&self) -> Vec<u8> {
        grab(&self.connect()).expect("a picture").as_flattened().to_vec()
    }
}

/// Everything that is on a screen now, row-major red, green, blue; fails where its server is gone.
pub fn grab((x, root): &(RustConnection, Window)) -> Result<Vec<[u8; 3]>, ReplyError> {
    let size = x.get_geometry(*root)?.reply()?;
    let image = x.get_image(ImageFormat::Z_PIXMAP, *root, 0, 0, size.width, size.height, !0)?.reply()?;
    assert_eq!(image.depth, 24);
    // 32 bits per pixel: blue, green, red, nothing.
    Ok(image.data.chunks_exact(4).map(|pixel| [pixel[2], pixel[1], pixel[0]]).collect())
}

/// The process with the window on `xvfb`: the one whose surroundings name its display.
pub fn window_process(xvfb: &Xvfb) -> Pid {
    let wanted = format!("DISPLAY={}", xvfb.display());
    let is_ours = |pid: i32| {
        let read = |name: &str| fs::read_to_string(format!("/proc/{pid}/{name}")).unwrap_or_default();
        read("cmdline").split('\0').nth(1) == Some("projector")
            && read("environ").split('\0').any(|variable| variable == wanted)
    };
    let pids = fs::read_dir("/proc").expect("processes").flatten();
    let pids = pids.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    let found: Vec<i32> = pids.filter(|pid| is_ours(*pid)).collect();
    let [pid] = found[..] else { panic!("one process with a window on {wanted}: {found:?}") };
    Pid::from_raw(pid).expect("a process")
}

impl Drop for Xvfb {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// A window of somebody else that covers a corner of the screen for as long as the connection lasts.
pub fn cover_a_corner(xvfb: &Xvfb) -> RustConnection {
    let (x, root) = xvfb.connect();
    let id = x.generate_id().expect("an id");
    let attributes = CreateWindowAux::new().override_redirect(1).background_pixel(0x00ff_ffff);
    x.create_window(24, id, root, 0, 0, 40, 30, 0, WindowClass::INPUT_OUTPUT, 0, &attributes)
        .expect("a request")
        .check()
        .expect("a window");
    x.map_window(id).expect("a request").check().expect("a window");
    x
}

/// The least of a window manager: it announces itself, places windows where it likes until they ask to be full-screen,
/// and then gives them the screen. `stubborn` ones do not. Runs until the server ends.
pub fn manage(xvfb: &Xvfb, stubborn: bool) {
    let (x, root) = xvfb.connect();
    let atom =
        |name: &str| x.intern_atom(false, name.as_bytes()).expect("a request").reply().expect("an atom").atom;
    let (check, supported) = (atom("_NET_SUPPORTING_WM_CHECK"), atom("_NET_SUPPORTED"));
    let (state, fullscreen) = (atom("_NET_WM_STATE"), atom("_NET_WM_STATE_FULLSCREEN"));
    let redirect = ChangeWindowAttributesAux::new()
        .event_mask(EventMask::SUBSTRUCTURE_REDIRECT | EventMask::SUBSTRUCTURE_NOTIFY);
    x.change_window_attributes(root, &redirect).expect("a request").check().expect("the only manager");
    let own = x.generate_id().expect("an id");
    let hidden = CreateWindowAux::new();
    x.create_window(24, own, root, -1, -1, 1, 1, 0, WindowClass::INPUT_OUTPUT, 0, &hidden)
        .expect("a request");
    for window in [root, own] {
        x.change_property32(PropMode::REPLACE, window, check, AtomEnum::WINDOW, &[own]).expect("a request");
    }
    let can = [check, state, fullscreen];
    x.change_property32(PropMode::REPLACE, root, supported, AtomEnum::ATOM, &can).expect("a request");
    let size = x.get_geometry(root).expect("a request").reply().expect("a size");
    let (width, height) = (u32::from(size.width), u32::from(size.height));
    let whole = ConfigureWindowAux::new().x(0).y(0).width(width).height(height);
    let small = ConfigureWindowAux::new().x(20).y(10).width(width / 2).height(height / 2);
    std::thread::spawn(move || {
        while let Ok(event) = x.wait_for_event() {
            let done = match event {
                Event::MapRequest(event) => {
                    let asked = x.get_property(false, event.window, state, AtomEnum::ATOM, 0, 8);
                    let asked = asked.expect("a request").reply().expect("a property");
                    let full =
                        asked.value32().is_some_and(|mut states| states.any(|asked| asked == fullscreen));
                    let place = if full && !stubborn { &whole } else { &small };
                    x.configure_window(event.window, place)
                        .and_then(|_| x.map_window(event.window))
                        .map(|_| ())
                }
                Event::ClientMessage(event) if event.type_ == state && !stubborn => {
                    x.configure_window(event.window, &whole).map(|_| ())
                }
                _ => Ok(()),
            };
            if done.and_then(|()| x.flush()).is_err() {
                return;
            }
        }
    });
}

/// Waits until `what` holds.
pub fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let since = Instant::now();
    while !holds() {
        assert!(since.elapsed() < Duration::from_secs(10), "not within 10 s: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
