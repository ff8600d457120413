//! Clients of the window: a thread for each, which turns bytes into demands and leaves the window to its own thread.

use std::{
    io::{self, Read, Write},
    os::{
        fd::AsFd,
        unix::{
            fs::{FileTypeExt, PermissionsExt},
            net::{UnixListener, UnixStream},
        },
    },
    path::Path,
    sync::Arc,
    time::Duration,
};

use winit::event_loop::EventLoopProxy;

use crate::{
    projector::Slide,
    window::{
        displays,
        protocol::{Asked, Fault, HEADER, Reply, Request, VERSION, Want, parse_header},
    },
};

/// Longest time that a client may leave an answer unread.
const WRITE: Duration = Duration::from_secs(1);

/// Most slides of one set: several scans' worth.
const SLIDES_MAX: u32 = 4096;

/// What the window is to do.
#[derive(Debug)]
pub enum Demand {
    /// Open on this display.
    Open(Want),
    /// Take these slides.
    Load(Vec<Slide>),
    /// Show one of them, or black.
    Show(Option<u32>),
}

/// Something for the window's thread.
#[derive(Debug)]
pub enum News {
    /// A client demands something.
    Demand(Client, Demand),
    /// A client has gone.
    Gone(u64),
}

/// One who may be answered.
#[derive(Debug, Clone)]
pub struct Client {
    /// Number among all clients.
    pub id: u64,
    stream: Arc<UnixStream>,
}

impl Client {
    /// Answers. A client that has gone away needs no answer; that it has is noticed where it is read from.
    pub fn answer(&self, reply: &Reply) {
        let _ = (&*self.stream).write_all(&reply.encode());
    }

    /// Answers that something failed.
    pub fn fail(&self, fault: Fault) {
        self.answer(&Reply::Failed(fault));
    }
}

/// The connection that whoever started this process left as its standard input.
pub fn inherited() -> io::Result<Client> {
    let stream = UnixStream::from(io::stdin().as_fd().try_clone_to_owned()?);
    // Fails where it is no socket.
    stream.peer_addr()?;
    client(0, stream)
}

/// Listens at `path` for ever, one client after the other; each is read on a thread of its own.
pub fn listen(path: &Path, proxy: EventLoopProxy<News>) -> io::Result<()> {
    // What a process left behind that was killed. A file that is no socket refuses connections as well: it stays, and is
    // the error.
    let socket = std::fs::symlink_metadata(path).is_ok_and(|entry| entry.file_type().is_socket());
    if socket
        && UnixStream::connect(path).is_err_and(|error| error.kind() == io::ErrorKind::ConnectionRefused)
    {
        std::fs::remove_file(path)?;
    }
    let listener = UnixListener::bind(path)?;
    // The service is another user; it shares the group of the folder.
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o660))?;
    std::thread::Builder::new().name("projector clients".into()).spawn(move || {
        for (id, stream) in (1..).zip(listener.incoming()) {
            let Ok(client) = stream.and_then(|stream| client(id, stream)) else { continue };
            // Without a thread for it a client is not served, and hears so by the end of its connection.
            let _ = follow(client, proxy.clone());
        }
    })?;
    Ok(())
}

fn client(id: u64, stream: UnixStream) -> io::Result<Client> {
    stream.set_write_timeout(Some(WRITE))?;
    Ok(Client { id, stream: Arc::new(stream) })
}

/// Reads what a client demands, on a thread of its own, until it goes.
pub fn follow(client: Client, proxy: EventLoopProxy<News>) -> io::Result<()> {
    std::thread::Builder::new().name("projector client".into()).spawn(move || {
        // An error ends the connection just as its end does.
        let _ = serve(&client, &proxy);
        let _ = client.stream.shutdown(std::net::Shutdown::Both);
        let _ = proxy.send_event(News::Gone(client.id));
    })?;
    Ok(())
}

fn serve(client: &Client, proxy: &EventLoopProxy<News>) -> io::Result<()> {
    loop {
        let demand = match read(&client.stream)? {
            Request::List { version } | Request::Open { version, .. } if version != VERSION => {
                client.fail(Fault::Refused {
                    what: Asked::Version,
                    requested: version.to_string(),
                    offered: format!("{VERSION}; restart it after an update"),
                });
                continue;
            }
            Request::List { .. } => {
                match displays::list(None) {
                    Ok(lines) => client.answer(&Reply::Displays(lines)),
                    Err(fault) => client.fail(fault),
                }
                continue;
            }
            Request::Open { want, .. } => Demand::Open(want),
            Request::Load { count } => {
                if count > SLIDES_MAX {
                    return Err(io::ErrorKind::InvalidData.into());
                }
                let mut slides = Vec::new();
                for _ in 0..count {
                    match read(&client.stream)? {
                        Request::Slide(slide) => slides.push(slide),
                        _ => return Err(io::ErrorKind::InvalidData.into()),
                    }
                }
                Demand::Load(slides)
            }
            Request::Slide(_) => return Err(io::ErrorKind::InvalidData.into()),
            Request::Show(slide) => Demand::Show(slide),
        };
        let sent = proxy.send_event(News::Demand(client.clone(), demand));
        sent.map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))?;
    }
}

fn read(mut stream: &UnixStream) -> io::Result<Request> {
    let bad = |error| io::Error::new(io::ErrorKind::InvalidData, error);
    let mut header = [0; HEADER];
    stream.read_exact(&mut header)?;
    let (length, kind) = parse_header(header).map_err(bad)?;
    let mut fields = Vec::new();
    // Memory grows with what comes, not with what was announced.
    let came = stream.take(length as u64).read_to_end(&mut fields)?;
    if came < length {
        return Err(io::ErrorKind::UnexpectedEof.into());
    }
    Request::decode(kind, &fields).map_err(bad)
}
