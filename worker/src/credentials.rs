//! What a client shows a server, and what it wants to be shown: a token, and a certificate.

use std::ffi::OsString;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use cache_proto::{VERSION, VERSION_KEY};
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::transport::Certificate;
use tonic::{Request, Status};

use crate::client::Address;

/// Header that names the relays a call has passed, separated by spaces.
pub const RELAYS: &str = "ambience-relays";

/// Environment variables for what is not given as an option.
const TOKEN: &str = "AMBIENCE_TOKEN";
const AUTHORITY: &str = "AMBIENCE_TLS_CA";

/// How to call a server that others can reach.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct CredentialArgs {
    /// Authority, PEM, that vouches for the server's certificate: TCP is encrypted [default: $AMBIENCE_TLS_CA]
    #[arg(long, value_name = "FILE")]
    pub tls_ca: Option<PathBuf>,
    /// File whose first line is the token to call with [default: the token in $AMBIENCE_TOKEN]
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Send the token to another machine even where it is not encrypted
    #[arg(long)]
    pub insecure: bool,
}

impl CredentialArgs {
    /// Reads files and environment, for calls to `server`.
    ///
    /// # Errors
    /// One line that says what is wrong with which of them; never the token.
    pub fn load(&self, server: &Address) -> Result<Credentials, String> {
        let variable = |name| std::env::var_os(name).filter(|value: &OsString| !value.is_empty());
        let authority = self.tls_ca.clone().or_else(|| variable(AUTHORITY).map(PathBuf::from));
        let authority = authority.filter(|_| matches!(server, Address::Tcp(_)));
        let authority = authority.map(Authority::load).transpose()?;
        let token = match &self.token_file {
            Some(path) => Some(first_line(path)?),
            None => variable(TOKEN)
                .map(|token| token.into_string().map_err(|_| format!("{TOKEN}: is not ASCII")))
                .transpose()?,
        };
        if token.is_some() && authority.is_none() && !self.insecure && !server.is_local() {
            return Err(format!(
                "the token for {server} could be read on its way: give --tls-ca, or say --insecure to send it all the same"
            ));
        }
        let from = || self.token_file.as_ref().map_or(TOKEN.into(), |path| format!("--token-file {}", path.display()));
        let bearer = token.map(|token| Bearer::new(&token).ok_or_else(|| format!("{}: is no token", from())));
        Ok(Credentials { authority, bearer: bearer.transpose()?.unwrap_or_default(), insecure: self.insecure })
    }
}

fn first_line(path: &Path) -> Result<String, String> {
    let text = fs::read_to_string(path).map_err(|error| format!("--token-file {}: {error}", path.display()))?;
    Ok(text.lines().next().unwrap_or_default().trim().into())
}

/// What [`CredentialArgs`] say. The default is to be asked nothing, and to ask nothing.
#[derive(Clone, Debug, Default)]
pub struct Credentials {
    authority: Option<Authority>,
    bearer: Bearer,
    insecure: bool,
}

impl Credentials {
    /// Whether the token may be sent to another machine as it is.
    pub fn insecure(&self) -> bool {
        self.insecure
    }

    /// Environment variables by which a process started here gets the same: what is in its arguments others can read.
    pub fn environment(&self) -> Vec<(&'static str, OsString)> {
        let authority = self.authority.as_ref().map(|authority| (AUTHORITY, authority.path.clone().into_os_string()));
        let token = self.bearer.token().map(|token| (TOKEN, token.into()));
        authority.into_iter().chain(token).collect()
    }

    /// Those variables, for processes that are to get none.
    pub const VARIABLES: [&str; 2] = [TOKEN, AUTHORITY];

    pub(crate) fn certificate(&self) -> Option<Certificate> {
        self.authority.as_ref().map(|authority| authority.certificate.clone())
    }

    /// The token.
    pub fn bearer(&self) -> Bearer {
        self.bearer.clone()
    }
}

/// Who vouches for servers.
#[derive(Clone, Debug)]
struct Authority {
    path: PathBuf,
    certificate: Certificate,
}

impl Authority {
    fn load(path: PathBuf) -> Result<Self, String> {
        let wrong = |what: &dyn fmt::Display| format!("--tls-ca {}: {what}", path.display());
        let pem = fs::read(&path).map_err(|error| wrong(&error))?;
        if !pem.windows(27).any(|bytes| bytes == b"-----BEGIN CERTIFICATE-----") {
            return Err(wrong(&"holds no PEM certificate"));
        }
        Ok(Self { certificate: Certificate::from_pem(pem), path })
    }
}

/// Adds this build's version to every call, and the token, if there is one. It is marked sensitive, so that no log shows it.
#[derive(Clone, Debug, Default)]
pub struct Bearer {
    authorization: Option<MetadataValue<Ascii>>,
    /// Those a call has passed, if this is a relay.
    relays: Option<MetadataValue<Ascii>>,
}

const SCHEME: &str = "Bearer ";

impl Bearer {
    fn new(token: &str) -> Option<Self> {
        if token.is_empty() || !token.bytes().all(|byte| byte.is_ascii_graphic()) {
            return None;
        }
        let mut value = MetadataValue::try_from(format!("{SCHEME}{token}")).ok()?;
        value.set_sensitive(true);
        Some(Self { authorization: Some(value), relays: None })
    }

    /// What a caller showed, shown again by a relay.
    pub fn relayed(authorization: Option<&[u8]>, relays: &str) -> Self {
        let mut authorization = authorization.and_then(|value| MetadataValue::try_from(value).ok());
        authorization.iter_mut().for_each(|value| value.set_sensitive(true));
        Self { authorization, ..Self::default() }.passing(relays)
    }

    /// The same, of a relay.
    pub fn passing(self, relays: &str) -> Self {
        Self { relays: MetadataValue::try_from(relays).ok(), ..self }
    }

    fn token(&self) -> Option<&str> {
        self.authorization.as_ref()?.to_str().ok()?.strip_prefix(SCHEME)
    }
}

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        request.metadata_mut().insert(VERSION_KEY, MetadataValue::from_static(VERSION));
        if let Some(value) = &self.authorization {
            request.metadata_mut().insert("authorization", value.clone());
        }
        if let Some(relays) = &self.relays {
            request.metadata_mut().insert(RELAYS, relays.clone());
        }
        Ok(request)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().expect("a file");
        fs::write(&file, text).expect("written");
        file
    }

    fn address(text: &str) -> Address {
        text.parse().expect("an address")
    }

    #[test]
    fn a_token_goes_to_other_machines_only_encrypted() {
        let token = file("0123456789abcdef\nnot this\n");
        let authority = file("-----BEGIN CERTIFICATE-----\n");
        let plain = CredentialArgs { token_file: Some(token.path().into()), ..CredentialArgs::default() };
        for local in ["127.0.0.1:1", "[::1]:1", "localhost:1", "unix:/s"] {
            let loaded = plain.load(&address(local)).expect("local");
            assert_eq!(loaded.environment(), [(TOKEN, OsString::from("0123456789abcdef"))]);
            assert!(!format!("{loaded:?}").contains("0123456789abcdef"));
        }
        for far in ["10.0.0.1:1", "farm:1", "[fe80::1]:1"] {
            let error = plain.load(&address(far)).expect_err("far");
            assert!(
                error.contains(far) && error.contains("--tls-ca") && !error.contains("0123456789abcdef"),
                "{error}"
            );
            assert!(CredentialArgs { insecure: true, ..plain.clone() }.load(&address(far)).is_ok());
            let encrypted = CredentialArgs { tls_ca: Some(authority.path().into()), ..plain.clone() };
            assert_eq!(encrypted.load(&address(far)).expect("encrypted").environment().len(), 2);
        }
    }

    #[test]
    fn what_is_wrong_with_a_file_is_said_and_no_token_shown() {
        let load = |token: Option<&Path>, authority: Option<&Path>| {
            let args = CredentialArgs {
                token_file: token.map(Into::into),
                tls_ca: authority.map(Into::into),
                insecure: false,
            };
            args.load(&address("127.0.0.1:1")).expect_err("wrong")
        };
        let (empty, spaced) = (file("\n"), file("secret secret secret"));
        for wrong in [empty.path(), spaced.path(), Path::new("/no/such/file")] {
            let error = load(Some(wrong), None);
            assert!(error.contains(&wrong.display().to_string()) && !error.contains("secret"), "{error}");
        }
        assert!(load(None, Some(spaced.path())).contains("no PEM certificate"));
    }
}
