//! `polscan serve`: the scanner as a service.

use std::{
    io::Write,
    net::SocketAddr,
    path::Path,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use tokio::{
    signal::unix::{SignalKind, signal},
    sync::watch,
};

use super::{notify::Notify, say};
use crate::{
    api::{self, App, Listening, Tls, TokenFile},
    config::Settings,
    engine::Failure,
    scanner::{self, RigState, Scanner, Snapshot, Threads},
    store::{Library, library::Recovery, time::rfc3339_utc},
};

/// How often systemd is asked for patience meanwhile, and for how much.
const PATIENCE: Duration = Duration::from_secs(5);

/// Threads that answer requests: they never compute.
const WORKERS: usize = 2;

fn setup(operation: &'static str, source: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Setup { operation, source: Box::new(source) }
}

/// Serves until it is asked to end. Writes the address that it listens on to `address_file`, if given.
pub fn serve(settings: Settings, address_file: Option<&Path>, json: bool) -> Result<u8, Failure> {
    let start = Instant::now();
    let tokens = settings.tokens.as_deref().map(TokenFile::open).transpose();
    let tokens = tokens.map_err(|error| setup("use the access tokens", error))?.map(Arc::new);
    let tls = settings.tls.as_ref().map(|(certificate, key)| Tls::read(certificate, key)).transpose();
    let tls = tls.map_err(|error| setup("use the certificate of the interface", error))?;
    let storage = |error| Failure::storage("open the store of scans", error);
    let library = Library::open(Path::new(&settings.raw.store.dir)).map_err(storage)?;
    let (index, recovery) = library.recover(&rfc3339_utc(SystemTime::now())).map_err(storage)?;
    report(&recovery);
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(WORKERS)
        .thread_name("http")
        .enable_all()
        .build()
        .map_err(|error| setup("start the threads of the interface", error))?;
    let listening = runtime
        .block_on(Listening::bind(settings.listen))
        .map_err(|error| setup("listen on the address in api.listen", error))?;
    let address = listening.address();
    if !address.ip().is_loopback() && tls.is_none() {
        tracing::warn!(%address, "tokens and scans cross the network unencrypted: set api.tls_certificate and api.tls_key");
    }
    let (scanner, threads) = scanner::start(settings.clone(), library, index)
        .map_err(|error| setup("start the threads of the scanner", error))?;
    let grace = Duration::from_secs_f64(settings.raw.api.stop_grace_s);
    let (stop, stopping) = watch::channel(false);
    let app = App::new(scanner.clone(), settings, tokens.clone(), listening.ip(), stopping.clone());
    runtime.block_on(async {
        let url = format!("{}://{address}", if tls.is_some() { "https" } else { "http" });
        let reloads = tokio::spawn(read_again(tokens, tls.clone(), signal(SignalKind::hangup())));
        let served = tokio::spawn(api::serve(listening, api::service(app), tls, stopping));
        announce(address, &url, scanner.folder(), address_file, json)?;
        let notify = Arc::new(Notify::from_environment());
        notify.send("READY=1");
        let elapsed_ms = start.elapsed().as_secs_f64() * 1e3;
        tracing::info!(%address, store = %scanner.folder().display(), elapsed_ms, "serving");
        let supervised = tokio::spawn(supervise(scanner.clone(), notify.clone()));
        let status = tokio::spawn(tell_status(scanner.clone(), notify.clone()));
        asked_to_end().await;
        end(&scanner, threads, grace, &notify).await;
        // Now whoever waited has its answer, and streams may break off.
        stop.send_replace(true);
        let _ = served.await;
        reloads.abort();
        supervised.abort();
        status.abort();
        Ok(0)
    })
}

fn report(recovery: &Recovery) {
    let Recovery { found, lost, interrupted, rebuilt } = recovery;
    if *rebuilt && !found.is_empty() {
        tracing::info!(scans = found.len(), "the index was made from the bundles");
    } else if !found.is_empty() {
        tracing::info!(?found, "bundles that the index did not know");
    }
    if !lost.is_empty() {
        tracing::warn!(?lost, "scans whose bundles are gone were forgotten");
    }
    if !interrupted.is_empty() {
        tracing::warn!(?interrupted, "scans that the last end of the service interrupted");
    }
}

/// Says where the service is: on stdout, and in a file for scripts.
fn announce(
    address: SocketAddr,
    url: &str,
    store: &Path,
    file: Option<&Path>,
    json: bool,
) -> Result<(), Failure> {
    if let Some(file) = file {
        let fresh = file.with_extension("new");
        let write = || {
            std::fs::File::create(&fresh)?.write_all(format!("{address}\n").as_bytes())?;
            std::fs::rename(&fresh, file)
        };
        write().map_err(|error| Failure::storage("write the address file", error))?;
    }
    match json {
        true => say(serde_json::json!({ "address": address, "url": url, "store": store })),
        false => say(format_args!("polscan serves {url}/ (interface: /docs), scans in {}", store.display())),
    }
    Ok(())
}

/// Reads tokens and certificate again at every SIGHUP.
async fn read_again(
    tokens: Option<Arc<TokenFile>>,
    tls: Option<Tls>,
    hangup: std::io::Result<tokio::signal::unix::Signal>,
) {
    let Ok(mut hangup) = hangup else {
        tracing::error!("SIGHUP cannot be received; certificates are read at the start only");
        return;
    };
    while hangup.recv().await.is_some() {
        if let Some(tokens) = &tokens {
            tokens.refresh();
        }
        match tls.as_ref().map(Tls::read_again) {
            Some(Ok(())) => tracing::info!("the certificate was read again"),
            Some(Err(error)) => {
                let error = crate::store::library::chain(&error);
                tracing::error!(error, "the certificate that was read before stays in use");
            }
            None => {}
        }
    }
}

/// Returns at the first signal to end; a second one ends the process at once.
async fn asked_to_end() {
    let signals = (signal(SignalKind::terminate()), signal(SignalKind::interrupt()));
    let (Ok(mut terminate), Ok(mut interrupt)) = signals else {
        tracing::error!("signals cannot be received; the service ends only when it is killed");
        return std::future::pending().await;
    };
    tokio::select! {
        _ = terminate.recv() => {}
        _ = interrupt.recv() => {}
    }
    tokio::spawn(async move {
        tokio::select! {
            _ = terminate.recv() => {}
            _ = interrupt.recv() => {}
        }
        tracing::warn!("ended at once");
        std::process::exit(130);
    });
}

/// Ends the scanner. The running scan comes to its end, or is cut short after a while; queued ones stay queued.
async fn end(scanner: &Scanner, threads: Threads, grace: Duration, notify: &Notify) {
    // First: whoever hears that the service is ending must not get a scan from it any more.
    scanner.stop(grace);
    notify.send("STOPPING=1");
    let mut joined = tokio::task::spawn_blocking(move || threads.join());
    while tokio::time::timeout(PATIENCE, &mut joined).await.is_err() {
        notify.send(&format!("EXTEND_TIMEOUT_USEC={}", 2 * PATIENCE.as_micros()));
    }
    tracing::info!("ended");
}

/// Tells the watchdog that owner and rig are alive, as long as they are.
async fn supervise(scanner: Scanner, notify: Arc<Notify>) {
    let Some(limit) = Notify::watchdog() else { return };
    loop {
        let oldest = scanner.heartbeats.iter().map(|heartbeat| heartbeat.age()).max().unwrap_or_default();
        if oldest < limit {
            notify.send("WATCHDOG=1");
        } else {
            tracing::error!(silent_s = oldest.as_secs_f64(), "the scanner gives no sign of life");
        }
        tokio::time::sleep(limit / 4).await;
    }
}

async fn tell_status(scanner: Scanner, notify: Arc<Notify>) {
    let mut snapshots = scanner.watch();
    let mut told = String::new();
    loop {
        let status = in_words(&snapshots.borrow_and_update().clone());
        if status != told {
            notify.send(&format!("STATUS={status}"));
            told = status;
        }
        // Nobody reads it more often.
        tokio::time::sleep(Duration::from_secs(1)).await;
        if snapshots.changed().await.is_err() {
            return;
        }
    }
}

fn in_words(snapshot: &Snapshot) -> String {
    let rig = match (&snapshot.capturing, snapshot.rig.state) {
        (Some(id), _) => format!("scanning {id}"),
        (None, RigState::Busy) if let Some(id) = &snapshot.calibrating => format!("calibrating {id}"),
        (None, RigState::Connecting) => "opening the rig".to_owned(),
        (None, RigState::Fault) => {
            format!("cannot scan: {}", snapshot.rig.message.clone().unwrap_or_default())
        }
        (None, _) if !snapshot.finishing.is_empty() => "decoding".to_owned(),
        (None, _) => "idle".to_owned(),
    };
    let queue = match snapshot.queue.len() {
        0 => String::new(),
        waiting => format!(", {waiting} waiting"),
    };
    // A status is one line.
    format!("{rig}{queue}").replace('\n', " ")
}
