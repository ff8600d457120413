//! The process that owns the window, `polscan projector`: winit on the main thread, wgpu below it, clients beside it.

use std::{io, os::unix::process::CommandExt, path::Path, process::Command};

use thiserror::Error;
use winit::{event_loop::EventLoop, platform::x11::EventLoopBuilderExtX11};

use super::protocol::Fault;

mod app;
mod gpu;
mod link;
mod open;
mod watch;

/// Keeps winit from scaling the window by what the screen says of its size in millimetres.
pub(super) const SCALE_VARIABLE: &str = "WINIT_X11_SCALE_FACTOR";

/// Why the process with the window cannot run.
#[derive(Debug, Error)]
pub enum ChildError {
    /// Without `--listen` it serves the program that started it, which gives it a socket as standard input.
    #[error("nobody started this process as a projector: give it --listen SOCKET to serve the service")]
    NoClient(#[source] io::Error),
    /// The socket cannot be listened on.
    #[error("cannot listen at {path}")]
    Listen {
        /// Path.
        path: String,
        /// Why not.
        #[source]
        source: io::Error,
    },
    /// There is no X server to open a window on.
    #[error("cannot open a window: {0}")]
    NoWindow(String),
    /// The program cannot start itself again with the right surroundings.
    #[error("cannot start again with {SCALE_VARIABLE}=1")]
    Again(#[source] io::Error),
}

/// Owns a window until the client has gone, or for ever where it listens at a path. For the main thread.
pub fn run(listen: Option<&Path>) -> Result<(), ChildError> {
    if std::env::var_os(SCALE_VARIABLE).is_none_or(|scale| scale != "1") {
        let mut again = Command::new("/proc/self/exe");
        again.args(std::env::args_os().skip(1)).env(SCALE_VARIABLE, "1");
        // Returns only where it failed.
        return Err(ChildError::Again(again.exec()));
    }
    let client = match listen {
        None => Some(link::inherited().map_err(ChildError::NoClient)?),
        Some(_) => None,
    };
    let built = EventLoop::<link::News>::with_user_event().with_x11().build();
    let event_loop = built.map_err(|_| {
        let shown = std::env::var("DISPLAY").unwrap_or_default();
        let text =
            format!("no connection to the X server at `{shown}`; is it running, and may this user use it?");
        if let Some(client) = &client {
            client.fail(Fault::Unavailable(text.clone()));
        }
        ChildError::NoWindow(text)
    })?;
    let proxy = event_loop.create_proxy();
    let alone = client.is_some();
    match (client, listen) {
        (Some(client), _) => link::follow(client, proxy).map_err(ChildError::NoClient)?,
        (None, Some(path)) => link::listen(path, proxy)
            .map_err(|source| ChildError::Listen { path: path.display().to_string(), source })?,
        (None, None) => {}
    }
    let mut app = app::App::new(alone);
    event_loop.run_app(&mut app).map_err(|error| ChildError::NoWindow(error.to_string()))
}
