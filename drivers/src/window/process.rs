//! The connection to the process with the window, and the process itself where it was started here.

use std::{
    collections::VecDeque,
    io::{self, BufRead, BufReader, Read, Write},
    os::{
        fd::OwnedFd,
        unix::{net::UnixStream, process::CommandExt},
    },
    path::Path,
    process::{Child, ChildStderr, Command, ExitStatus, Stdio},
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use super::{
    WindowOptions,
    child::SCALE_VARIABLE,
    protocol::{HEADER, Reply, parse_header},
};

/// Lines of the process that are kept for the moment when it ends.
const LINES: usize = 4;

/// What libraries always say where there is no desktop, and what is wrong with nothing.
const NOISE: [&str; 2] = ["XDG_RUNTIME_DIR is invalid or not set", "error setting XSETTINGS"];

/// How long a process may take to end by itself.
const ENDING: Duration = Duration::from_millis(500);

/// A connection, and the process at its other end where it was started here.
pub struct Process {
    stream: UnixStream,
    child: Option<Child>,
    lines: Arc<Mutex<VecDeque<String>>>,
}

/// Why no answer came.
#[derive(Debug)]
pub enum Silence {
    /// It did not come in time.
    Late,
    /// The other end is gone, or says what is no answer.
    Gone(io::Error),
}

impl Process {
    /// Starts a process, or connects to one that runs.
    pub fn start(options: &WindowOptions) -> io::Result<Self> {
        match &options.socket {
            Some(path) => Self::connect(path),
            None => Self::spawn(options),
        }
    }

    fn connect(path: &Path) -> io::Result<Self> {
        Ok(Self { stream: UnixStream::connect(path)?, child: None, lines: Arc::default() })
    }

    fn spawn(options: &WindowOptions) -> io::Result<Self> {
        let (stream, theirs) = UnixStream::pair()?;
        let mut command = Command::new(&options.program);
        command
            .arg("projector")
            .env(SCALE_VARIABLE, "1")
            // Patterns are for the display that was named, whatever a desktop's session says.
            .env_remove("WAYLAND_DISPLAY")
            .stdin(Stdio::from(OwnedFd::from(theirs)))
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Ctrl-C at a terminal is for the service, which leaves black behind before it ends.
            .process_group(0);
        if let Some(display) = &options.x11_display {
            command.env("DISPLAY", display);
        }
        let mut child = command.spawn()?;
        let lines = Arc::<Mutex<VecDeque<String>>>::default();
        if let Some(said) = child.stderr.take() {
            let kept = lines.clone();
            std::thread::Builder::new()
                .name("projector messages".into())
                .spawn(move || pass_on(said, &kept))?;
        }
        Ok(Self { stream, child: Some(child), lines })
    }

    /// Number of the process where it was started here.
    pub fn id(&self) -> Option<u32> {
        self.child.as_ref().map(Child::id)
    }

    /// Sends `messages` and waits for an answer until `deadline`.
    pub fn ask(&self, messages: &[Vec<u8>], deadline: Instant) -> Result<Reply, Silence> {
        for message in messages {
            self.stream.set_write_timeout(Some(left(deadline)?)).map_err(Silence::Gone)?;
            (&self.stream).write_all(message).map_err(silence)?;
        }
        let mut header = [0; HEADER];
        self.read(&mut header, deadline)?;
        let bad = |error| Silence::Gone(io::Error::new(io::ErrorKind::InvalidData, error));
        let (length, kind) = parse_header(header).map_err(bad)?;
        // Answers are short: whoever announces more is none of ours.
        if length > 1 << 20 {
            return Err(Silence::Gone(io::ErrorKind::InvalidData.into()));
        }
        let mut fields = vec![0; length];
        self.read(&mut fields, deadline)?;
        Reply::decode(kind, &fields).map_err(bad)
    }

    fn read(&self, mut into: &mut [u8], deadline: Instant) -> Result<(), Silence> {
        while !into.is_empty() {
            self.stream.set_read_timeout(Some(left(deadline)?)).map_err(Silence::Gone)?;
            match (&self.stream).read(into) {
                Ok(0) => return Err(Silence::Gone(io::ErrorKind::UnexpectedEof.into())),
                Ok(count) => into = &mut into[count..],
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(silence(error)),
            }
        }
        Ok(())
    }

    /// Whether the other end is still there. It says nothing unasked, so that anything to read is its end.
    pub fn is_there(&mut self) -> bool {
        let ended = |child: &mut Child| !matches!(child.try_wait(), Ok(None));
        if self.child.as_mut().is_some_and(ended) || self.stream.set_nonblocking(true).is_err() {
            return false;
        }
        let read = (&self.stream).read(&mut [0]);
        let back = self.stream.set_nonblocking(false);
        back.is_ok() && read.is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
    }

    /// How the process ended and what it said last, in words; waits a moment for it.
    pub fn last_words(&mut self) -> String {
        let status = self.child.as_mut().and_then(|child| ended(child, ENDING));
        let status = status.map(|status| format!("{status}")).unwrap_or_else(|| "connection closed".into());
        let lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        lines.back().map_or(status.clone(), |line| format!("{status}; its last words: {line}"))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
        if let Some(mut child) = self.child.take()
            && ended(&mut child, ENDING).is_none()
        {
            // It does not listen. Both calls fail only where it has ended meanwhile; one that a GPU's driver holds may not
            // end for long, and nobody has to wait for it.
            let _ = child.kill();
            std::thread::spawn(move || drop(child.wait()));
        }
    }
}

/// How a process ended, if it does within `patience`.
fn ended(child: &mut Child, patience: Duration) -> Option<ExitStatus> {
    let since = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Some(status),
            Ok(None) if since.elapsed() < patience => std::thread::sleep(Duration::from_millis(5)),
            _ => return None,
        }
    }
}

/// Time left until `deadline`; a time-out of zero would be none.
fn left(deadline: Instant) -> Result<Duration, Silence> {
    let left = deadline.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(Silence::Late) } else { Ok(left) }
}

fn silence(error: io::Error) -> Silence {
    match error.kind() {
        io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut => Silence::Late,
        _ => Silence::Gone(error),
    }
}

/// Passes on what the process says, and keeps the end of it.
fn pass_on(said: ChildStderr, kept: &Mutex<VecDeque<String>>) {
    for line in BufReader::new(said).lines().map_while(Result::ok) {
        if NOISE.iter().any(|noise| line.contains(noise)) {
            continue;
        }
        let _ = writeln!(io::stderr(), "projector: {line}");
        let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
        if !line.trim().is_empty() {
            kept.push_back(line.trim().to_owned());
        }
        if kept.len() > LINES {
            kept.pop_front();
        }
    }
}
