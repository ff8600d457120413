//! Encryption of the interface: a certificate and its key, read at the start and again when somebody asks for it.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
};

use thiserror::Error;
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        self, ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem, pem::PemObject},
    },
};

/// Certificate or key cannot be used.
#[derive(Debug, Error)]
pub enum TlsError {
    /// A file cannot be read.
    #[error("cannot read {} named in {key}", path.display())]
    File {
        /// Key of the configuration.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A file does not hold what it should.
    #[error("{} named in {key} holds no {wanted} in PEM form", path.display())]
    Content {
        /// Key of the configuration.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// What it should hold.
        wanted: &'static str,
        /// Why.
        #[source]
        source: pem::Error,
    },
    /// The key is not that of the certificate, or of a kind that is not known.
    #[error("api.tls_key {} does not belong to the first certificate in api.tls_certificate {}", key.display(), certificate.display())]
    Mismatch {
        /// File of the certificate.
        certificate: PathBuf,
        /// File of the key.
        key: PathBuf,
        /// Why.
        #[source]
        source: rustls::Error,
    },
}

/// Certificate and key in use. Cheap to clone.
#[derive(Clone)]
pub struct Tls {
    certificate: PathBuf,
    key: PathBuf,
    config: Arc<RwLock<Arc<ServerConfig>>>,
}

impl Tls {
    /// Reads the certificate, with those of its issuers after it, and its key.
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, TlsError> {
        let config = Arc::new(RwLock::new(config(certificate, key)?));
        Ok(Self { certificate: certificate.to_owned(), key: key.to_owned(), config })
    }

    /// Reads both files again: connections made from now on get what they hold. After an error, what was read before.
    pub fn read_again(&self) -> Result<(), TlsError> {
        let fresh = config(&self.certificate, &self.key)?;
        *self.config.write().unwrap_or_else(PoisonError::into_inner) = fresh;
        Ok(())
    }

    /// For one connection.
    pub fn acceptor(&self) -> TlsAcceptor {
        self.config.read().unwrap_or_else(PoisonError::into_inner).clone().into()
    }
}

fn read(key: &'static str, path: &Path) -> Result<Vec<u8>, TlsError> {
    std::fs::read(path).map_err(|source| TlsError::File { key, path: path.to_owned(), source })
}

fn config(certificate: &Path, key: &Path) -> Result<Arc<ServerConfig>, TlsError> {
    let name = "api.tls_certificate";
    let content =
        |source| TlsError::Content { key: name, path: certificate.to_owned(), wanted: "certificate", source };
    let bytes = read(name, certificate)?;
    let chain: Vec<CertificateDer<'static>> =
        CertificateDer::pem_slice_iter(&bytes).collect::<Result<_, _>>().map_err(content)?;
    if chain.is_empty() {
        return Err(content(pem::Error::NoItemsFound));
    }
    let name = "api.tls_key";
    let private = PrivateKeyDer::from_pem_slice(&read(name, key)?).map_err(|source| TlsError::Content {
        key: name,
        path: key.to_owned(),
        wanted: "private key",
        source,
    })?;
    let mismatch =
        |source| TlsError::Mismatch { certificate: certificate.to_owned(), key: key.to_owned(), source };
    let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(mismatch)?
        .with_no_client_auth()
        .with_single_cert(chain, private)
        .map_err(mismatch)?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(Arc::new(config))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Certificate and key in PEM form.
    fn pair() -> (String, String) {
        let made = rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
        (made.cert.pem(), made.signing_key.serialize_pem())
    }

    #[test]
    fn what_cannot_be_used_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let ((certificate, key), (_, other)) = (pair(), pair());
        let files = [("certificate", &certificate), ("key", &key), ("other", &other)];
        files.iter().for_each(|(name, text)| std::fs::write(path(name), text).unwrap());
        std::fs::write(path("empty"), "").unwrap();
        let read = |certificate: &str, key: &str| Tls::read(&path(certificate), &path(key));
        assert!(read("certificate", "key").is_ok());
        let said = |certificate: &str, key: &str| read(certificate, key).err().unwrap().to_string();
        assert!(said("none", "key").contains("none named in api.tls_certificate"));
        assert!(said("certificate", "none").contains("none named in api.tls_key"));
        assert!(said("empty", "key").contains("holds no certificate"));
        assert!(said("certificate", "empty").contains("holds no private key"));
        assert!(said("certificate", "certificate").contains("holds no private key"));
        assert!(said("certificate", "other").contains("does not belong"));
    }

    #[test]
    fn what_was_read_stays_where_reading_again_fails() {
        let folder = tempfile::tempdir().unwrap();
        let (certificate, key) = (folder.path().join("c"), folder.path().join("k"));
        let first = pair();
        std::fs::write(&certificate, &first.0).unwrap();
        std::fs::write(&key, &first.1).unwrap();
        let tls = Tls::read(&certificate, &key).unwrap();
        let used = |tls: &Tls| Arc::as_ptr(tls.acceptor().config());
        let before = used(&tls);
        std::fs::write(&key, pair().1).unwrap();
        assert!(matches!(tls.read_again(), Err(TlsError::Mismatch { .. })));
        assert_eq!(used(&tls), before);
        std::fs::write(&key, &first.1).unwrap();
        tls.read_again().unwrap();
        assert_ne!(used(&tls), before);
    }
}
