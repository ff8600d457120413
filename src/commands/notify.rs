//! Telling systemd how the service is: `sd_notify(3)` over its socket.

use std::{
    os::{
        linux::net::SocketAddrExt,
        unix::{
            ffi::OsStrExt,
            net::{SocketAddr, UnixDatagram},
        },
    },
    time::Duration,
};

/// The socket of the service manager, if there is one.
#[derive(Debug)]
pub struct Notify(Option<(UnixDatagram, SocketAddr)>);

impl Notify {
    /// The socket that `NOTIFY_SOCKET` names.
    pub fn from_environment() -> Self {
        let Some(name) = std::env::var_os("NOTIFY_SOCKET") else { return Self(None) };
        let address = match name.as_bytes().strip_prefix(b"@") {
            Some(name) => SocketAddr::from_abstract_name(name),
            None => SocketAddr::from_pathname(&name),
        };
        let socket = || {
            let socket = UnixDatagram::unbound()?;
            // A manager that does not listen must not hold up the service.
            socket.set_nonblocking(true)?;
            Ok::<_, std::io::Error>(socket)
        };
        match address.and_then(|address| Ok((socket()?, address))) {
            Ok(socket) => Self(Some(socket)),
            Err(error) => {
                tracing::warn!(%error, "the service manager cannot be told anything");
                Self(None)
            }
        }
    }

    /// Sends one or more assignments.
    pub fn send(&self, text: &str) {
        if let Some((socket, address)) = &self.0
            && let Err(error) = socket.send_to_addr(text.as_bytes(), address)
        {
            tracing::warn!(%error, text, "the service manager was not told");
        }
    }

    /// Within which time the service manager wants signs of life.
    pub fn watchdog() -> Option<Duration> {
        let ours = std::env::var("WATCHDOG_PID").map_or(Ok(std::process::id()), |pid| pid.parse());
        let limit = std::env::var("WATCHDOG_USEC").ok()?.parse().ok().map(Duration::from_micros)?;
        (ours == Ok(std::process::id())).then_some(limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_kinds_of_addresses_are_reached() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let name = format!("polscan-test-{}", std::process::id());
        let addresses =
            [SocketAddr::from_pathname(&path).unwrap(), SocketAddr::from_abstract_name(name).unwrap()];
        for address in addresses {
            let manager = UnixDatagram::bind_addr(&address).unwrap();
            let notify = Notify(Some((UnixDatagram::unbound().unwrap(), address)));
            notify.send("READY=1");
            let mut buffer = [0; 64];
            let length = manager.recv(&mut buffer).unwrap();
            assert_eq!(&buffer[..length], b"READY=1");
        }
        Notify(None).send("READY=1");
    }
}
