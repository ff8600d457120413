//! Who may do what: bearer tokens with scopes, or, without tokens, this machine alone.

use std::{
    fmt,
    io::Write,
    net::IpAddr,
    os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown},
    path::{Path, PathBuf},
    str::FromStr,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use axum::http::{HeaderMap, Method, Uri, header, uri::Authority};
use sha2::{Digest, Sha256};
use subtle::ConstantTimeEq;
use thiserror::Error;

use super::problem::{Kind, Problem};

/// What a token allows; each includes those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scope {
    /// Look at everything.
    Read,
    /// Scan, and change what belongs to scans.
    Scan,
    /// Delete and calibrate.
    Admin,
}

impl Scope {
    const ALL: [Self; 3] = [Self::Read, Self::Scan, Self::Admin];

    fn name(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Scan => "scan",
            Self::Admin => "admin",
        }
    }
}

impl fmt::Display for Scope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Scope {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.into_iter().find(|scope| scope.name() == text);
        found.ok_or_else(|| format!("`{text}` is none of read, scan, admin"))
    }
}

/// Prefix by which tokens are recognised in logs and repositories.
const PREFIX: &str = "polscan_";

/// Random bytes of a token.
const SECRET_BYTES: usize = 32;

/// A file of tokens cannot be used.
#[derive(Debug, Error)]
pub enum TokenError {
    /// It cannot be read or written.
    #[error("cannot {operation} the token file {}", path.display())]
    File {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Others may read it.
    #[error("the token file {} has mode {mode:03o}: others could read it; run chmod 600 on it", path.display())]
    Mode {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// A line is wrong.
    #[error("the token file {} is wrong in line {line}: expected NAME SCOPE SHA256", path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
    /// A name that cannot be one.
    #[error(
        "`{0}` cannot name a token: use letters, digits, - and _, and a name that is not in the file yet"
    )]
    Name(String),
    /// A name that no token has.
    #[error("no token in {} is named `{name}`; `polscan token list` names them", path.display())]
    Unknown {
        /// The file.
        path: PathBuf,
        /// The name.
        name: String,
    },
    /// There is no token.
    #[error("the token file {} has no token: make one with `polscan token add`", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The system gives no random numbers.
    #[error("no random numbers for a token: {0}")]
    Random(String),
}

#[derive(Debug, Clone)]
struct Token {
    name: String,
    scope: Scope,
    hash: [u8; 32],
}

/// The tokens of a file. Only their hashes are known; they are random enough that a plain hash cannot be reversed.
#[derive(Debug, Clone, Default)]
pub struct Tokens(Vec<Token>);

impl Tokens {
    /// Reads a file that only its owner may read.
    pub fn read(path: &Path) -> Result<Self, TokenError> {
        let fail = |source| TokenError::File { operation: "read", path: path.to_owned(), source };
        let mode = std::fs::metadata(path).map_err(fail)?.permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(TokenError::Mode { path: path.to_owned(), mode });
        }
        let text = std::fs::read_to_string(path).map_err(fail)?;
        let lines =
            text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
        let tokens: Result<Vec<Token>, TokenError> = lines
            .map(|(index, line)| {
                parse(line).ok_or_else(|| TokenError::Line { path: path.to_owned(), line: index + 1 })
            })
            .collect();
        Ok(Self(tokens?))
    }

    /// Reads a file that must hold at least one token.
    pub fn required(path: &Path) -> Result<Self, TokenError> {
        let tokens = Self::read(path)?;
        if tokens.0.is_empty() {
            return Err(TokenError::Empty { path: path.to_owned() });
        }
        Ok(tokens)
    }

    /// Name and scope of each, in the order of the file.
    pub fn names(&self) -> impl Iterator<Item = (&str, Scope)> {
        self.0.iter().map(|token| (token.name.as_str(), token.scope))
    }

    /// What `secret` allows. Takes as long for a wrong one as for a right one.
    fn scope(&self, secret: &str) -> Option<Scope> {
        let hash = digest(secret);
        self.0.iter().fold(None, |found, token| {
            let equal: bool = token.hash.ct_eq(&hash).into();
            if equal { Some(token.scope) } else { found }
        })
    }
}

fn digest(secret: &str) -> [u8; 32] {
    Sha256::digest(secret.as_bytes()).into()
}

fn parse(line: &str) -> Option<Token> {
    let mut words = line.split_whitespace();
    let (name, scope, hex) = (words.next()?, words.next()?.parse().ok()?, words.next()?);
    if words.next().is_some() || hex.len() != 64 || !hex.is_ascii() {
        return None;
    }
    let mut hash = [0; 32];
    for (at, byte) in hash.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&hex[2 * at..2 * at + 2], 16).ok()?;
    }
    Some(Token { name: name.to_owned(), scope, hash })
}

/// Makes a token and adds its hash to the file, which is made where it is missing. Returns the token: it is not kept.
pub fn add_token(path: &Path, name: &str, scope: Scope) -> Result<String, TokenError> {
    let fail = |source| TokenError::File { operation: "write", path: path.to_owned(), source };
    let known = if path.exists() { Tokens::read(path)?.0 } else { Vec::new() };
    let plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'-' || byte == b'_';
    if name.is_empty() || !name.bytes().all(plain) || known.iter().any(|token| token.name == name) {
        return Err(TokenError::Name(name.to_owned()));
    }
    let mut random = [0u8; SECRET_BYTES];
    getrandom::fill(&mut random).map_err(|error| TokenError::Random(error.to_string()))?;
    let secret = format!("{PREFIX}{}", crate::store::source::hex(&random));
    let mut file = std::fs::File::options().create(true).append(true).mode(0o600).open(path).map_err(fail)?;
    let line = format!("{name} {scope} {}\n", crate::store::source::hex(&digest(&secret)));
    file.write_all(line.as_bytes()).and_then(|()| file.sync_all()).map_err(fail)?;
    Ok(secret)
}

/// Takes a token out of the file, which changes at once and as a whole and keeps its owner.
pub fn revoke_token(path: &Path, name: &str) -> Result<(), TokenError> {
    let fail = |source| TokenError::File { operation: "write", path: path.to_owned(), source };
    if Tokens::read(path)?.names().all(|(known, _)| known != name) {
        return Err(TokenError::Unknown { path: path.to_owned(), name: name.to_owned() });
    }
    let text = std::fs::read_to_string(path).map_err(fail)?;
    let left: String = text
        .split_inclusive('\n')
        .filter(|line| line.starts_with('#') || line.split_whitespace().next() != Some(name))
        .collect();
    let mut fresh = path.as_os_str().to_owned();
    fresh.push(".new");
    let write = || {
        let owner = std::fs::metadata(path)?;
        let _ = std::fs::remove_file(&fresh);
        let mut file = std::fs::File::options().create_new(true).write(true).mode(0o600).open(&fresh)?;
        // Somebody else may do this than who runs the service.
        fchown(&file, Some(owner.uid()), Some(owner.gid()))?;
        file.write_all(left.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&fresh, path)
    };
    write().map_err(fail)
}

/// How soon a change of the file is noticed.
const FRESH: Duration = Duration::from_secs(1);

/// What tells one state of a file from another: inode, length, and when it was changed.
type Stamp = (u64, u64, i64, i64);

/// The tokens of a running service, which follows the changes of their file.
#[derive(Debug)]
pub struct TokenFile {
    path: PathBuf,
    known: Mutex<Known>,
}

#[derive(Debug)]
struct Known {
    tokens: Arc<Tokens>,
    stamp: Option<Stamp>,
    looked: Instant,
}

impl TokenFile {
    /// A file that must hold at least one token now.
    pub fn open(path: &Path) -> Result<Self, TokenError> {
        // Before the content: a change in between is then read once more than needed, not once less.
        let stamp = stamp(path);
        let tokens = Arc::new(Tokens::required(path)?);
        let known = Mutex::new(Known { tokens, stamp, looked: Instant::now() });
        Ok(Self { path: path.to_owned(), known })
    }

    /// The tokens as they are, or were a moment ago. A file that cannot be used lets nobody in until it is mended: what
    /// it revoked must not go on.
    fn current(&self) -> Arc<Tokens> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if known.looked.elapsed() >= FRESH {
            self.look(&mut known);
        }
        known.tokens.clone()
    }

    /// Follows the file now.
    pub fn refresh(&self) {
        self.look(&mut self.known.lock().unwrap_or_else(PoisonError::into_inner));
    }

    fn look(&self, known: &mut Known) {
        known.looked = Instant::now();
        let stamp = stamp(&self.path);
        if stamp == known.stamp {
            return;
        }
        known.stamp = stamp;
        known.tokens = Arc::new(Tokens::read(&self.path).unwrap_or_else(|error| {
            let error = crate::store::library::chain(&error);
            tracing::error!(error, "nobody is let in before the token file is mended");
            Tokens::default()
        }));
        tracing::info!(tokens = known.tokens.0.len(), "the token file was read again");
    }
}

fn stamp(path: &Path) -> Option<Stamp> {
    // The time of the inode: it moves with content, mode and owner, and no program can set it back.
    let data = std::fs::metadata(path).ok()?;
    Some((data.ino(), data.len(), data.ctime(), data.ctime_nsec()))
}

/// What a request needs.
fn needed(method: &Method, path: &str) -> Option<Scope> {
    let open = ["/livez", "/readyz", "/", "/docs", "/openapi.json"];
    if open.contains(&path) || path.starts_with("/assets/") {
        return None;
    }
    Some(match *method {
        Method::GET | Method::HEAD => Scope::Read,
        Method::DELETE => Scope::Admin,
        _ if path.starts_with("/v1/calibrations") => Scope::Admin,
        _ => Scope::Scan,
    })
}

/// How requests are judged.
#[derive(Debug, Clone)]
pub struct Gate {
    /// Tokens; without any, this machine alone is served.
    pub tokens: Option<Arc<TokenFile>>,
    /// Address that the service listens on.
    pub address: IpAddr,
}

impl Gate {
    /// Lets a request pass or says why not.
    pub fn check(&self, method: &Method, uri: &Uri, headers: &HeaderMap) -> Result<(), Problem> {
        let Some(needed) = needed(method, uri.path()) else { return Ok(()) };
        match &self.tokens {
            Some(tokens) => check_token(&tokens.current(), needed, headers),
            None => self.check_machine(method, uri, headers),
        }
    }

    /// Without tokens a request must be made on this machine and not by a page of somebody else's. A browser names the
    /// page's host in `Origin`, and after a DNS rebinding in `Host`.
    fn check_machine(&self, method: &Method, uri: &Uri, headers: &HeaderMap) -> Result<(), Problem> {
        let text = |name| headers.get(name).and_then(|value| value.to_str().ok());
        let host = text(header::HOST).or(uri.host());
        if !host.is_some_and(|host| self.is_own(host)) {
            return Err(Kind::Foreign
                .with("the Host of the request is not this machine; without tokens only it is served"));
        }
        if *method == Method::GET || *method == Method::HEAD {
            return Ok(());
        }
        if let Some(origin) = headers.get(header::ORIGIN) {
            let own = origin.to_str().ok().and_then(|origin| origin.split_once("://"));
            if !own.is_some_and(|(_, host)| self.is_own(host)) {
                return Err(Kind::Foreign.with("the Origin of the request is not this machine"));
            }
        }
        Ok(())
    }

    fn is_own(&self, host: &str) -> bool {
        let Ok(authority) = host.parse::<Authority>() else { return false };
        let name = authority.host().trim_start_matches('[').trim_end_matches(']');
        let address = name.parse::<IpAddr>();
        name.eq_ignore_ascii_case("localhost")
            || address.is_ok_and(|address| address.is_loopback() || address == self.address)
    }
}

fn check_token(tokens: &Tokens, needed: Scope, headers: &HeaderMap) -> Result<(), Problem> {
    let given = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let bearer = given.and_then(|text| {
        let (kind, secret) = text.split_once(' ')?;
        kind.eq_ignore_ascii_case("bearer").then(|| secret.trim())
    });
    match bearer.and_then(|secret| tokens.scope(secret)) {
        None => {
            Err(Kind::Unauthorized
                .with("send `Authorization: Bearer TOKEN` with a token of `polscan token add`"))
        }
        Some(scope) if scope < needed => {
            Err(Kind::Scope.with(format!("the token has scope {scope}, this needs {needed}")))
        }
        Some(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderValue, StatusCode};

    use super::*;

    fn gate(tokens: Option<Arc<TokenFile>>) -> Gate {
        Gate { tokens, address: IpAddr::from([127, 0, 0, 1]) }
    }

    fn status(
        gate: &Gate,
        method: Method,
        path: &str,
        headers: &[(&'static str, &str)],
    ) -> Option<StatusCode> {
        let headers = headers
            .iter()
            .map(|(name, value)| {
                (header::HeaderName::from_static(name), HeaderValue::from_str(value).unwrap())
            })
            .collect();
        gate.check(&method, &path.parse().unwrap(), &headers).err().map(|problem| problem.status())
    }

    #[test]
    fn without_tokens_only_this_machine_is_served() {
        let gate = gate(None);
        let get = |host| status(&gate, Method::GET, "/v1/scans", &[("host", host)]);
        for own in ["127.0.0.1:8631", "localhost:1", "LOCALHOST", "[::1]:8631", "127.0.0.1"] {
            assert_eq!(get(own), None, "{own}");
        }
        for other in
            ["evil.example", "evil.example:8631", "127.0.0.1.evil.example", "localhost.evil", "10.0.0.1", ""]
        {
            assert_eq!(get(other), Some(StatusCode::FORBIDDEN), "{other}");
        }
        let post =
            |origin| status(&gate, Method::POST, "/v1/scans", &[("host", "localhost"), ("origin", origin)]);
        for own in ["http://localhost:8631", "http://127.0.0.1:3000", "https://[::1]"] {
            assert_eq!(post(own), None, "{own}");
        }
        for other in ["null", "http://evil.example", "file://", "http://localhost.evil.example", ""] {
            assert_eq!(post(other), Some(StatusCode::FORBIDDEN), "{other}");
        }
        assert_eq!(status(&gate, Method::POST, "/v1/scans", &[("host", "localhost")]), None);
        assert_eq!(status(&gate, Method::GET, "/livez", &[("host", "probe.example")]), None);
    }

    #[test]
    fn scopes_reach_as_far_as_they_say() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        let secrets: Vec<String> =
            Scope::ALL.iter().map(|scope| add_token(&path, scope.name(), *scope).unwrap()).collect();
        let gate = gate(Some(Arc::new(TokenFile::open(&path).unwrap())));
        let cases = [
            (Method::GET, "/v1/scans", Scope::Read),
            (Method::GET, "/metrics", Scope::Read),
            (Method::POST, "/v1/scans", Scope::Scan),
            (Method::PUT, "/v1/projector", Scope::Scan),
            (Method::DELETE, "/v1/scans/a", Scope::Admin),
            (Method::POST, "/v1/calibrations/rig", Scope::Admin),
        ];
        for (method, path, needed) in cases {
            for (secret, scope) in secrets.iter().zip(Scope::ALL) {
                let found =
                    status(&gate, method.clone(), path, &[("authorization", &format!("Bearer {secret}"))]);
                assert_eq!(
                    found,
                    (scope < needed).then_some(StatusCode::FORBIDDEN),
                    "{method} {path} {scope}"
                );
            }
            for wrong in ["Bearer x", "Bearer ", "Basic x", ""] {
                let found = status(&gate, method.clone(), path, &[("authorization", wrong)]);
                assert_eq!(found, Some(StatusCode::UNAUTHORIZED));
            }
        }
        assert_eq!(status(&gate, Method::GET, "/livez", &[]), None);
    }

    #[test]
    fn changes_of_the_file_are_followed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        let first = add_token(&path, "first", Scope::Admin).unwrap();
        let file = TokenFile::open(&path).unwrap();
        let scope = |secret: &str| {
            file.refresh();
            file.current().scope(secret)
        };
        let second = add_token(&path, "second", Scope::Read).unwrap();
        assert_eq!((scope(&first), scope(&second)), (Some(Scope::Admin), Some(Scope::Read)));
        revoke_token(&path, "first").unwrap();
        assert_eq!((scope(&first), scope(&second)), (None, Some(Scope::Read)));
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        // What cannot be used lets nobody in, and is mended as it was broken.
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert_eq!(scope(&second), None);
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        assert_eq!(scope(&second), Some(Scope::Read));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(scope(&second), None);
    }

    #[test]
    fn a_token_is_revoked_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        for name in ["a", "ab", "b"] {
            add_token(&path, name, Scope::Scan).unwrap();
        }
        let with_note = format!("# a note\n{}", std::fs::read_to_string(&path).unwrap());
        std::fs::write(&path, &with_note).unwrap();
        assert!(matches!(revoke_token(&path, "c"), Err(TokenError::Unknown { .. })));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), with_note);
        revoke_token(&path, "a").unwrap();
        let left = Tokens::read(&path).unwrap();
        assert_eq!(left.names().collect::<Vec<_>>(), [("ab", Scope::Scan), ("b", Scope::Scan)]);
        assert!(std::fs::read_to_string(&path).unwrap().starts_with("# a note\nab "));
    }

    #[test]
    fn the_file_is_private_and_holds_no_secret() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tokens");
        let secret = add_token(&path, "bench", Scope::Scan).unwrap();
        assert!(secret.len() > 60);
        assert!(!std::fs::read_to_string(&path).unwrap().contains(&secret[PREFIX.len()..]));
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(matches!(add_token(&path, "bench", Scope::Read), Err(TokenError::Name(_))));
        assert!(matches!(add_token(&path, "a b", Scope::Read), Err(TokenError::Name(_))));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(matches!(Tokens::read(&path), Err(TokenError::Mode { mode: 0o644, .. })));
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        std::fs::write(&path, "# nothing\n").unwrap();
        assert!(matches!(Tokens::required(&path), Err(TokenError::Empty { .. })));
        std::fs::write(&path, "a admin 00\n").unwrap();
        assert!(matches!(Tokens::read(&path), Err(TokenError::Line { line: 1, .. })));
    }
}
