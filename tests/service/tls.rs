//! Encryption: only HTTPS is understood, the certificate can be changed, and what is wrong with it is said.

use std::{
    fs,
    io::{Read, Write},
    net::TcpStream,
    process::Command,
    sync::Arc,
    time::{Duration, Instant},
};

use serde_json::json;
use tokio_rustls::rustls::{
    ClientConfig, ClientConnection, RootCertStore, StreamOwned,
    crypto::ring,
    pki_types::{CertificateDer, ServerName},
};

use crate::{
    client::{send, try_send},
    daemon::Daemon,
    rig::{Rig, polscan, text},
};

/// Writes a new certificate and its key, and answers the certificate.
fn renew(rig: &Rig) -> CertificateDer<'static> {
    let made =
        rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).expect("a certificate of our own");
    fs::write(rig.path("certificate.pem"), made.cert.pem()).expect("a certificate of our own");
    fs::write(rig.path("key.pem"), made.signing_key.serialize_pem()).expect("a certificate of our own");
    made.cert.der().clone()
}

fn encrypted() -> (Rig, CertificateDer<'static>) {
    let rig = Rig::small().set("api.tls_certificate", "certificate.pem").set("api.tls_key", "key.pem");
    let certificate = renew(&rig);
    (rig, certificate)
}

/// Asks by HTTPS, trusting `certificate` alone. What went wrong otherwise.
fn ask(daemon: &Daemon, certificate: &CertificateDer<'static>, request: &str) -> std::io::Result<String> {
    let mut roots = RootCertStore::empty();
    roots.add(certificate.clone()).expect("a certificate");
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_root_certificates(roots)
        .with_no_client_auth();
    let name = ServerName::try_from("localhost").expect("a name");
    let connection = ClientConnection::new(Arc::new(config), name).expect("a client");
    let mut stream = StreamOwned::new(connection, TcpStream::connect(daemon.address())?);
    stream.write_all(request.as_bytes())?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    Ok(answer)
}

const STATUS: &str = "GET /v1/status HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";

#[test]
fn with_a_certificate_only_https_is_understood_and_a_hangup_changes_it() {
    let (rig, first) = encrypted();
    let daemon = Daemon::on(rig).started();
    let answer = ask(&daemon, &first, STATUS).unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    let body = json!({ "mode": "fast" }).to_string();
    let post = format!(
        "POST /v1/scans?wait=done HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n\
         Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    );
    let answer = ask(&daemon, &first, &post).unwrap();
    assert!(answer.starts_with("HTTP/1.1 202") && answer.contains("\"state\":\"done\""), "{answer}");
    assert!(try_send(daemon.address(), "GET", "/livez", &[], b"").is_none(), "plain text is not understood");

    // A new certificate is used once somebody says so; one without its key leaves the old one in use.
    let hang_up = || {
        let id = daemon.process().to_string();
        assert!(Command::new("kill").args(["-HUP", &id]).status().unwrap().success());
    };
    let said = |words: &str| {
        let start = Instant::now();
        while !daemon.log().contains(words) {
            assert!(start.elapsed() < Duration::from_secs(20), "{words}: {}", daemon.log());
            std::thread::sleep(Duration::from_millis(5));
        }
    };
    let second = renew(&daemon.rig);
    assert!(ask(&daemon, &first, STATUS).is_ok(), "not by itself");
    hang_up();
    said("the certificate was read again");
    assert!(ask(&daemon, &second, STATUS).unwrap().starts_with("HTTP/1.1 200"));
    assert!(ask(&daemon, &first, STATUS).is_err());
    fs::write(daemon.rig.path("key.pem"), "").unwrap();
    hang_up();
    said("the certificate that was read before stays in use");
    assert!(ask(&daemon, &second, STATUS).unwrap().starts_with("HTTP/1.1 200"));
}

#[test]
fn a_certificate_that_cannot_be_used_keeps_the_service_from_starting() {
    let (rig, _) = encrypted();
    let refused = |rig: &Rig, words: &str| {
        let config = rig.config();
        let run = polscan(&["serve", "--config", text(&config), "--listen", "127.0.0.1:0"]).expect(64);
        assert!(run.stderr.contains(words), "{words}: {}", run.stderr);
    };
    let key = fs::read(rig.path("key.pem")).unwrap();
    fs::remove_file(rig.path("key.pem")).unwrap();
    refused(&rig, "api.tls_key");
    renew(&rig);
    fs::write(rig.path("key.pem"), key).unwrap();
    refused(&rig, "does not belong");
    refused(&rig.set("api.tls_key", ""), "certificate and key are needed together");
}

#[test]
fn tokens_that_would_cross_the_network_in_clear_are_warned_of() {
    let warning = "cross the network unencrypted";
    let warned = |rig: Rig, address: &str| {
        let file = rig.path("tokens");
        polscan(&["token", "add", "a", "--scope", "admin", "--file", text(&file)]).expect(0);
        let daemon = Daemon::on_address(rig.set("api.tokens", "tokens"), address).started();
        daemon.log().contains(warning)
    };
    assert!(warned(Rig::small(), "0.0.0.0:0"));
    assert!(!warned(encrypted().0, "0.0.0.0:0"));
    assert!(!warned(Rig::small(), "127.0.0.1:0"));
}

#[test]
fn tokens_that_are_added_and_revoked_count_without_a_restart() {
    let rig = Rig::small();
    let file = rig.path("tokens");
    let token = |arguments: &[&str]| {
        let all = [&["token"], arguments, &["--file", text(&file)]].concat();
        polscan(&all).expect(0).stdout.trim().to_owned()
    };
    token(&["add", "first", "--scope", "admin"]);
    let daemon = Daemon::on(rig.set("api.tokens", "tokens")).started();
    let until = |secret: &str, status: u16| {
        let start = Instant::now();
        let header = format!("Bearer {secret}");
        while send(daemon.address(), "GET", "/v1/status", &[("Authorization", &header)], b"").status != status
        {
            assert!(start.elapsed() < Duration::from_secs(10), "{status} does not come");
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    let second = token(&["add", "second", "--scope", "read"]);
    until(&second, 200);
    assert_eq!(token(&["list"]), "first admin\nsecond read");
    token(&["revoke", "second"]);
    until(&second, 401);
    assert_eq!(token(&["list"]), "first admin");
    let unknown = polscan(&["token", "revoke", "second", "--file", text(&file)]);
    assert!(unknown.code != 0 && unknown.stderr.contains("polscan token list"), "{}", unknown.stderr);
}
