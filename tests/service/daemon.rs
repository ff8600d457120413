//! The program as a service, in a process of its own, on a small twin.

use std::{
    fs,
    io::{BufRead, BufReader},
    net::{Ipv4Addr, SocketAddr},
    path::PathBuf,
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::{
    client::{Answer, send},
    rig::{Rig, text},
};

const JSON: (&str, &str) = ("Content-Type", "application/json");

/// In hexadecimal digits.
pub fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A configuration, a store, and the process that serves them, which may be started again.
pub struct Daemon {
    pub rig: Rig,
    pub store: PathBuf,
    environment: Vec<(String, String)>,
    child: Option<Child>,
    address: Option<SocketAddr>,
}

impl Daemon {
    /// Not yet started.
    pub fn on(rig: Rig) -> Self {
        let store = rig.path("store");
        Self::in_store(rig, store)
    }

    /// Not yet started, with its scans somewhere else.
    pub fn in_store(rig: Rig, store: PathBuf) -> Self {
        Self::listening(rig, store, "127.0.0.1:0")
    }

    /// Not yet started, with its scans in the rig's folder, on another address.
    pub fn on_address(rig: Rig, address: &str) -> Self {
        let store = rig.path("store");
        Self::listening(rig, store, address)
    }

    fn listening(rig: Rig, store: PathBuf, address: &str) -> Self {
        // The disk of the tests is whatever it is.
        let rig =
            rig.set("store.dir", text(&store)).set("store.min_free_gib", 0.0).set("api.listen", address);
        Self { rig, store, environment: Vec::new(), child: None, address: None }
    }

    /// Started, as fast as it can be computed.
    pub fn fast() -> Self {
        Self::on(Rig::small()).started()
    }

    /// Started, at the pace of a real rig: long enough for something to happen meanwhile.
    pub fn real_time() -> Self {
        Self::on(Rig::small().set("sim.pacing", "real-time")).started()
    }

    /// Sets a variable of the process.
    pub fn with(mut self, name: &str, value: &str) -> Self {
        self.environment.push((name.to_owned(), value.to_owned()));
        self
    }

    /// Starts it.
    pub fn started(mut self) -> Self {
        self.start();
        self
    }

    /// Starts it, again perhaps.
    pub fn start(&mut self) {
        let log = fs::File::options().create(true).append(true).open(self.rig.path("log")).expect("a log");
        let mut child = Command::new(env!("CARGO_BIN_EXE_polscan"))
            .args(["serve", "--json", "--config", text(&self.rig.config())])
            .envs(self.environment.iter().cloned())
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .expect("polscan starts");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("a pipe")).read_line(&mut line).expect("a line");
        let said: Value = serde_json::from_str(&line).unwrap_or_else(|error| {
            let _ = child.wait();
            panic!("{error} in {line:?}; log:\n{}", self.log())
        });
        let mut address: SocketAddr =
            said["address"].as_str().expect("an address").parse().expect("an address");
        if address.ip().is_unspecified() {
            address.set_ip(Ipv4Addr::LOCALHOST.into());
        }
        self.address = Some(address);
        self.child = Some(child);
    }

    /// What it logged.
    pub fn log(&self) -> String {
        fs::read_to_string(self.rig.path("log")).unwrap_or_default()
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address.expect("it was started")
    }

    /// Its number among the processes of this machine.
    pub fn process(&self) -> u32 {
        self.child.as_ref().expect("it runs").id()
    }

    /// Ends it in the middle of whatever it does.
    pub fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().expect("it can be killed");
            child.wait().expect("it ends");
        }
    }

    /// Asks it to end.
    pub fn terminate(&self) {
        let id = self.child.as_ref().expect("it runs").id();
        let done = Command::new("kill").args(["-TERM", &id.to_string()]).status();
        assert!(done.expect("kill runs").success());
    }

    /// Asks it to end and waits until it has.
    pub fn stop(&mut self) -> ExitStatus {
        self.terminate();
        self.stop_waiting()
    }

    /// Waits until it has ended, as it was asked to.
    pub fn stop_waiting(&mut self) -> ExitStatus {
        self.child.take().expect("it runs").wait().expect("it ends")
    }

    pub fn get(&self, path: &str) -> Answer {
        send(self.address(), "GET", path, &[], b"")
    }

    pub fn post(&self, path: &str, body: &Value) -> Answer {
        send(self.address(), "POST", path, &[JSON], body.to_string().as_bytes())
    }

    pub fn request(&self, method: &str, path: &str, body: &Value) -> Answer {
        send(self.address(), method, path, &[JSON], body.to_string().as_bytes())
    }

    /// Posts a scan that is accepted, and returns its identity.
    #[track_caller]
    pub fn scan(&self, body: &Value) -> String {
        self.post("/v1/scans", body).expect(202).json()["id"].as_str().expect("an identity").to_owned()
    }

    /// One scan.
    #[track_caller]
    pub fn state(&self, id: &str) -> Value {
        self.get(&format!("/v1/scans/{id}")).expect(200).json()
    }

    /// A scan at its end.
    #[track_caller]
    pub fn done(&self, id: &str) -> Value {
        self.get(&format!("/v1/scans/{id}?wait=done")).expect(200).json()
    }

    /// Waits until `reached` holds of a scan.
    #[track_caller]
    pub fn until(&self, id: &str, reached: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let scan = self.state(id);
            if reached(&scan) {
                return scan;
            }
            assert!(start.elapsed() < Duration::from_secs(60), "{scan}\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until the rig is open.
    pub fn ready(&self) {
        let start = Instant::now();
        while self.get("/readyz").status != 200 {
            assert!(start.elapsed() < Duration::from_secs(60), "{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// A scan that has come to its end.
    pub fn finished_scan(&self) -> Value {
        let scan = self.post("/v1/scans?wait=done", &json!({ "mode": "fast" })).expect(202).json();
        assert_eq!(scan["state"], "done", "{scan}");
        scan
    }

    /// Names of the folders that look like bundles.
    pub fn bundles(&self) -> Vec<String> {
        let entries = fs::read_dir(&self.store).expect("the store");
        let names = entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"));
        let mut names: Vec<String> =
            names.filter(|name| !name.starts_with('.') && !name.starts_with("index.")).collect();
        names.sort();
        names
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        self.kill();
        if std::thread::panicking() {
            eprintln!("{}", self.log());
        }
    }
}
