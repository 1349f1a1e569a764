//! The server's certificate and key, checked before anybody is served with them.

use std::fs;
use std::io;
use std::path::Path;
use std::time::Duration;

use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, UnixTime};
use tonic::transport::{Identity, Server, ServerTlsConfig};
use webpki::{EndEntityCert, KeyUsage};

use crate::door::GREETING;

/// What a server proves with who it is, and encrypts with.
#[derive(Clone)]
pub struct Tls(ServerTlsConfig);

impl Tls {
    /// Reads PEM files: a chain of certificates, the server's own first, and its key; `now` is the time since 1970.
    ///
    /// # Errors
    /// One line that names the file: not readable, not what it should be, not valid now, or not matching the other.
    pub fn load(certificate: &Path, key: &Path, now: Duration) -> Result<Self, String> {
        let read = |what, path: &Path| {
            let cannot = |error: io::Error| format!("{what} {}: {error}", path.display());
            fs::read(path).map_err(cannot)
        };
        let (chain, secret) = (read("certificate", certificate)?, read("key", key)?);
        valid_at(&chain, now).map_err(|what| format!("certificate {}: {what}", certificate.display()))?;
        let tls = ServerTlsConfig::new().identity(Identity::from_pem(chain, secret)).timeout(GREETING);
        // It is here that both are read and compared.
        Server::builder().tls_config(tls.clone()).map_err(|error| {
            format!("certificate {} with key {}: {}", certificate.display(), key.display(), cause(&error))
        })?;
        Ok(Self(tls))
    }

    /// As the transport wants it.
    pub(crate) fn config(&self) -> &ServerTlsConfig {
        &self.0
    }
}

/// Whether the first certificate is valid at a time. Of all that a client would object to only this is of interest: who
/// signed it and for which names is known to the clients alone.
fn valid_at(chain: &[u8], now: Duration) -> Result<(), String> {
    let first = CertificateDer::from_pem_slice(chain).map_err(|error| format!("is no PEM certificate ({error})"))?;
    let certificate = EndEntityCert::try_from(&first).map_err(|error| format!("cannot be read ({error})"))?;
    let (now, usage) = (UnixTime::since_unix_epoch(now), KeyUsage::server_auth());
    match certificate.verify_for_usage(&[], &[], &[], now, usage, None, None) {
        Err(webpki::Error::CertExpired { not_after, .. }) => {
            let days = now.as_secs().saturating_sub(not_after.as_secs()) / 86_400;
            Err(format!("has expired {days} days ago"))
        }
        Err(webpki::Error::CertNotValidYet { .. }) => Err("is not valid yet".into()),
        _ => Ok(()),
    }
}

/// The innermost reason of an error; those around it say less.
fn cause(error: &dyn std::error::Error) -> String {
    let mut cause = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause.to_string()
}
