//! A client of HTTP that is simple enough to be trusted, and that can misbehave.

use std::{
    collections::BTreeMap,
    io::{BufRead, BufReader, Read, Write},
    net::{SocketAddr, TcpStream},
    time::Duration,
};

use serde_json::Value;

/// Longest silence of a service that is alive.
const PATIENCE: Duration = Duration::from_secs(60);

/// An answer.
#[derive(Debug)]
pub struct Answer {
    /// Status.
    pub status: u16,
    /// Headers, names in lower case.
    pub headers: BTreeMap<String, String>,
    /// Body.
    pub body: Vec<u8>,
}

impl Answer {
    /// Panics with the whole answer unless it has `status`.
    #[track_caller]
    pub fn expect(self, status: u16) -> Self {
        let text = String::from_utf8_lossy(&self.body[..self.body.len().min(2000)]).into_owned();
        assert_eq!(self.status, status, "{:?} {text}", self.headers);
        if status >= 400 {
            assert_eq!(self.header("content-type"), "application/problem+json", "{text}");
            let problem = self.json();
            assert_eq!(problem["status"], status);
            assert!(problem["detail"].as_str().is_some_and(|detail| !detail.is_empty()), "{text}");
        }
        self
    }

    /// A header, empty where it is missing.
    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).map_or("", String::as_str)
    }

    /// The body as JSON.
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body)
            .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&self.body)))
    }

    /// Slug of the problem.
    pub fn slug(&self) -> String {
        self.json()["type"].as_str().unwrap_or_default().to_owned()
    }
}

/// Sends a request as it is written and reads the answer.
pub fn send(address: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)], body: &[u8]) -> Answer {
    let mut reader = open(address, method, path, headers, body);
    let (status, headers) = read_head(&mut reader);
    let mut content = Vec::new();
    let chunked = headers.get("transfer-encoding").is_some_and(|coding| coding == "chunked");
    if method != "HEAD" && chunked {
        while let Some(chunk) = read_chunk(&mut reader) {
            content.extend(chunk);
        }
    } else if method != "HEAD" {
        let length = headers.get("content-length").map_or(0, |length| length.parse().expect("a length"));
        content.resize(length, 0);
        reader.read_exact(&mut content).expect("the whole body");
    }
    Answer { status, headers, body: content }
}

/// Sends a request to a service that may die meanwhile; nothing where the answer is not whole.
pub fn try_send(
    address: SocketAddr,
    method: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &[u8],
) -> Option<Answer> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(PATIENCE)).ok()?;
    let length = body.len();
    let mut head = format!(
        "{method} {path} HTTP/1.1\r\nConnection: close\r\nHost: {address}\r\nContent-Length: {length}\r\n"
    );
    headers.iter().for_each(|(name, value)| head.push_str(&format!("{name}: {value}\r\n")));
    head.push_str("\r\n");
    stream.write_all(head.as_bytes()).and_then(|()| stream.write_all(body)).ok()?;
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).ok()?;
    let end = bytes.windows(4).position(|window| window == b"\r\n\r\n")?;
    let text = String::from_utf8(bytes[..end].to_vec()).ok()?;
    let mut lines = text.split("\r\n");
    let status = lines.next()?.split(' ').nth(1)?.parse().ok()?;
    let header = |line: &str| {
        let (name, value) = line.split_once(':')?;
        Some((name.to_ascii_lowercase(), value.trim().to_owned()))
    };
    let headers: BTreeMap<String, String> = lines.filter_map(header).collect();
    let body = bytes.split_off(end + 4);
    let whole = headers.get("content-length").and_then(|length| length.parse().ok()) == Some(body.len());
    whole.then_some(Answer { status, headers, body })
}

/// Sends a request and leaves the answer to be read.
pub fn open(
    address: SocketAddr,
    method: &str,
    path: &str,
    headers: &[(&str, &str)],
    body: &[u8],
) -> BufReader<TcpStream> {
    let mut stream = TcpStream::connect(address).expect("the service listens");
    stream.set_read_timeout(Some(PATIENCE)).expect("a limit");
    let mut head = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|(name, _)| name.eq_ignore_ascii_case("host")) {
        head.push_str(&format!("Host: {address}\r\n"));
    }
    if !body.is_empty() {
        head.push_str(&format!("Content-Length: {}\r\n", body.len()));
    }
    for (name, value) in headers {
        head.push_str(&format!("{name}: {value}\r\n"));
    }
    head.push_str("\r\n");
    stream.write_all(head.as_bytes()).expect("the request is sent");
    // A service may refuse a body before it has all of it.
    let _ = stream.write_all(body);
    BufReader::new(stream)
}

/// Status and headers.
pub fn read_head(reader: &mut BufReader<TcpStream>) -> (u16, BTreeMap<String, String>) {
    let line = |reader: &mut BufReader<TcpStream>| {
        let mut line = String::new();
        reader.read_line(&mut line).expect("a line of the answer");
        line.trim_end().to_owned()
    };
    let first = line(reader);
    let status = first.split(' ').nth(1).and_then(|status| status.parse().ok());
    let status = status.unwrap_or_else(|| panic!("no status in {first:?}"));
    let mut headers = BTreeMap::new();
    loop {
        let next = line(reader);
        let Some((name, value)) = next.split_once(':') else { break };
        headers.insert(name.to_ascii_lowercase(), value.trim().to_owned());
    }
    (status, headers)
}

/// The next piece of a chunked body; `None` at its end.
pub fn read_chunk(reader: &mut BufReader<TcpStream>) -> Option<Vec<u8>> {
    let mut line = String::new();
    reader.read_line(&mut line).ok()?;
    let length = usize::from_str_radix(line.trim(), 16).ok()?;
    let mut chunk = vec![0; length + 2];
    reader.read_exact(&mut chunk).expect("the whole chunk");
    chunk.truncate(length);
    (length > 0).then_some(chunk)
}

/// One server-sent event.
#[derive(Debug, Clone, PartialEq)]
pub struct Event {
    /// Number.
    pub id: u64,
    /// What it is about.
    pub kind: String,
    /// Data.
    pub data: Value,
}

/// A stream of events.
pub struct Events {
    reader: BufReader<TcpStream>,
    text: String,
}

impl Events {
    /// Follows events, from after `last` or from now on.
    pub fn follow(address: SocketAddr, last: Option<u64>) -> Self {
        let last = last.map(|last| last.to_string());
        let headers: Vec<(&str, &str)> = last.iter().map(|last| ("Last-Event-ID", last.as_str())).collect();
        let mut reader = open(address, "GET", "/v1/events", &headers, b"");
        let (status, headers) = read_head(&mut reader);
        assert_eq!((status, headers["content-type"].as_str()), (200, "text/event-stream"));
        assert_eq!(headers["x-accel-buffering"], "no");
        let mut events = Self { reader, text: String::new() };
        // The greeting says that the stream stands, so that nothing after it can be missed.
        while !events.text.contains("\n\n") {
            events.more();
        }
        events
    }

    fn more(&mut self) {
        let chunk = read_chunk(&mut self.reader).expect("the stream goes on");
        self.text.push_str(&String::from_utf8(chunk).expect("events are text"));
    }

    /// The next event; heartbeats are passed over.
    pub fn next(&mut self) -> Event {
        loop {
            while let Some((block, rest)) = self.text.split_once("\n\n") {
                let field = |name: &str| {
                    block
                        .lines()
                        .find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
                        .map(str::to_owned)
                };
                let event = field("id").zip(field("event")).zip(field("data"));
                self.text = rest.to_owned();
                if let Some(((id, kind), data)) = event {
                    let data = serde_json::from_str(&data).expect("data is JSON");
                    return Event { id: id.parse().expect("a number"), kind, data };
                }
            }
            self.more();
        }
    }
}
