//! An X server without a display, and what is on its screen.

use std::{
    io::{BufRead, BufReader},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use x11rb::{
    connection::Connection,
    protocol::xproto::{ConnectionExt as _, CreateWindowAux, ImageFormat, Window, WindowClass},
    rust_connection::RustConnection,
};

/// An Xvfb of this test, ended with it.
pub struct Xvfb {
    server: Child,
    /// Number of its display.
    pub number: u32,
}

impl Xvfb {
    /// Starts one on a display that nobody has.
    pub fn start(width: u32, height: u32) -> Self {
        Self::launch(None, width, height)
    }

    /// Starts one on the display of one that has ended.
    pub fn start_at(number: u32, width: u32, height: u32) -> Self {
        Self::launch(Some(number), width, height)
    }

    fn launch(number: Option<u32>, width: u32, height: u32) -> Self {
        let mut command = Command::new("Xvfb");
        command.args(number.map(|number| format!(":{number}")));
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
        let (x, root) = self.connect();
        let size = x.get_geometry(root).expect("a request").reply().expect("a size");
        let image = x
            .get_image(ImageFormat::Z_PIXMAP, root, 0, 0, size.width, size.height, !0)
            .expect("a request")
            .reply()
            .expect("a picture");
        assert_eq!(image.depth, 24);
        // 32 bits per pixel: blue, green, red, nothing.
        image.data.chunks_exact(4).flat_map(|pixel| [pixel[2], pixel[1], pixel[0]]).collect()
    }
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

/// Waits until `what` holds.
pub fn eventually(what: &str, mut holds: impl FnMut() -> bool) {
    let since = Instant::now();
    while !holds() {
        assert!(since.elapsed() < Duration::from_secs(10), "not within 10 s: {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
