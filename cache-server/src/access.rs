//! Who may call: tokens, and the tenants whose names they carry. Of a token only its hash is kept; no message names it.

use std::fmt;
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::Arc;

use subtle::{ConditionallySelectable as _, ConstantTimeEq as _};
use tonic::codegen::http::HeaderValue;

use crate::refusal::Refusal;

/// Environment variable that holds the token of the one tenant `default`, where there is no token file.
pub const TOKEN_VARIABLE: &str = "AMBIENCE_TOKEN";

/// Longest name of a tenant, bytes.
const NAME_MAX: usize = 64;

/// Shortest and longest token, bytes.
const TOKEN_MIN: usize = 16;
const TOKEN_MAX: usize = 1024;

/// Most tokens of one server: each call looks at all of them.
const TOKENS_MAX: usize = 1024;

/// On whose behalf a call is made: the name of its token, empty on a server without tokens. Namespaces, frames and
/// workers of one tenant are none of another's business.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Default)]
pub struct Tenant(Arc<str>);

impl Tenant {
    /// Its name.
    pub fn name(&self) -> &str {
        &self.0
    }
}

impl From<&str> for Tenant {
    fn from(name: &str) -> Self {
        Self(name.into())
    }
}

impl fmt::Display for Tenant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// The header a call was let in with, for those who pass it on.
#[derive(Clone)]
pub struct Shown(pub Option<HeaderValue>);

/// On whose behalf a request is made.
pub fn tenant<T>(request: &tonic::Request<T>) -> Tenant {
    request.extensions().get().cloned().unwrap_or_default()
}

/// The tokens a server accepts; without any, everybody may call, as the tenant without a name.
#[derive(Clone, Default)]
pub struct Tokens(Vec<(blake3::Hash, Tenant)>);

/// The names alone, so that no log can tell a token.
impl fmt::Debug for Tokens {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.0.iter().map(|(_, tenant)| tenant)).finish()
    }
}

impl Tokens {
    /// Reads a token file: a name and a token on each line; what follows a `#` at the start of a line is a comment. A
    /// name may stand on several lines, so that its token can be changed while both are in use.
    ///
    /// # Errors
    /// One line that names the file, and the line of it, but never a token.
    pub fn load(path: &Path) -> Result<Self, String> {
        let wrong = |what: &dyn fmt::Display| format!("token file {}: {what}", path.display());
        let cannot = |error: io::Error| wrong(&error);
        let mode = fs::metadata(path).map_err(cannot)?.permissions().mode();
        if mode & 0o077 != 0 {
            return Err(wrong(&format_args!("others may read it; run: chmod 600 {}", path.display())));
        }
        let text = fs::read_to_string(path).map_err(cannot)?;
        let tokens = Self::parse(&text).map_err(|(line, what)| wrong(&format_args!("line {line}: {what}")))?;
        if tokens.is_empty() { Err(wrong(&"no tokens; expected lines `NAME TOKEN`")) } else { Ok(tokens) }
    }

    /// One token, of the tenant `default`.
    ///
    /// # Errors
    /// What is wrong with it, without naming it.
    pub fn single(token: &str) -> Result<Self, String> {
        check_token(token).map_err(|what| format!("{TOKEN_VARIABLE}: {what}"))?;
        Ok(Self(vec![(blake3::hash(token.as_bytes()), "default".into())]))
    }

    fn parse(text: &str) -> Result<Self, (usize, String)> {
        let mut tokens = Self::default();
        for (at, line) in text.lines().enumerate() {
            if line.trim().is_empty() || line.starts_with('#') {
                continue;
            }
            tokens.add(line).map_err(|what| (at + 1, what))?;
        }
        Ok(tokens)
    }

    fn add(&mut self, line: &str) -> Result<(), String> {
        let words: Vec<_> = line.split_whitespace().collect();
        let [name, token] = words[..] else {
            return Err(format!("has {} words, expected `NAME TOKEN`", words.len()));
        };
        let sound = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if name.len() > NAME_MAX || !name.chars().all(sound) {
            return Err(format!("the name is not 1 to {NAME_MAX} of A-Z a-z 0-9 . _ -"));
        }
        check_token(token)?;
        if self.0.len() >= TOKENS_MAX {
            return Err(format!("more than {TOKENS_MAX} tokens"));
        }
        let hash = blake3::hash(token.as_bytes());
        if let Some((_, other)) = self.0.iter().find(|(known, _)| *known == hash) {
            return Err(format!("the token of {name} is also that of {other}, on a line before"));
        }
        self.0.push((hash, name.into()));
        Ok(())
    }

    /// Whether none is asked for.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The tenants they stand for, each once.
    pub fn names(&self) -> Vec<&str> {
        let names: std::collections::BTreeSet<_> = self.0.iter().map(|(_, tenant)| tenant.name()).collect();
        names.into_iter().collect()
    }

    /// The tenant behind the value of an `authorization` header. What is compared are hashes, each with every entry, so
    /// that the time it takes tells nothing about how close a guess came.
    ///
    /// # Errors
    /// [`Refusal::Unknown`] without a token, or with one that is not known.
    pub fn check(&self, authorization: Option<&[u8]>) -> Result<Tenant, Refusal> {
        if self.is_empty() {
            return Ok(Tenant::default());
        }
        let wanted = "this server wants a token: authorization: Bearer TOKEN";
        let token = authorization.and_then(bearer).ok_or(Refusal::Unknown(wanted))?;
        let hash = blake3::hash(token);
        let mut found = u64::MAX;
        for (at, (known, _)) in (0..).zip(&self.0) {
            let same = known.as_bytes().ct_eq(hash.as_bytes());
            found.conditional_assign(&at, same);
        }
        let found = usize::try_from(found).ok().and_then(|at| self.0.get(at));
        found.map(|(_, tenant)| tenant.clone()).ok_or(Refusal::Unknown("the token is not one of this server's"))
    }
}

/// The token of `Bearer TOKEN`; the scheme's name is the same in small letters.
fn bearer(authorization: &[u8]) -> Option<&[u8]> {
    let (scheme, token) = authorization.split_at_checked(b"Bearer ".len())?;
    scheme.eq_ignore_ascii_case(b"Bearer ").then_some(token)
}

/// Whether a token can travel in a header and is long enough not to be guessed.
fn check_token(token: &str) -> Result<(), String> {
    if !(TOKEN_MIN..=TOKEN_MAX).contains(&token.len()) {
        return Err(format!("the token has {} bytes, expected {TOKEN_MIN} to {TOKEN_MAX}", token.len()));
    }
    if !token.bytes().all(|byte| byte.is_ascii_graphic()) {
        return Err("the token has bytes that are not printable ASCII".into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIGHT: &str = "0123456789abcdef";
    const COMP: &str = "fedcba9876543210fedcba";

    fn file(mode: u32, text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().expect("a file");
        fs::write(&file, text).expect("written");
        fs::set_permissions(&file, fs::Permissions::from_mode(mode)).expect("mode");
        file
    }

    fn name(tokens: &Tokens, authorization: &str) -> Option<String> {
        tokens.check(Some(authorization.as_bytes())).ok().map(|tenant| tenant.to_string())
    }

    #[test]
    fn a_token_stands_for_its_tenant() {
        let file = file(0o600, &format!("# who\n\nlight {LIGHT}\n  comp.2 \t{COMP}\nlight another-token-of-it\n"));
        let tokens = Tokens::load(file.path()).expect("sound");
        assert_eq!(tokens.names(), ["comp.2", "light"]);
        for (token, tenant) in [(LIGHT, "light"), (COMP, "comp.2"), ("another-token-of-it", "light")] {
            assert_eq!(name(&tokens, &format!("Bearer {token}")).as_deref(), Some(tenant));
            assert_eq!(name(&tokens, &format!("bearer {token}")).as_deref(), Some(tenant));
        }
        let wrong = ["", "Bearer", "Bearer ", LIGHT, "Basic 0123456789abcdef", "Bearer 0123456789abcdeF"];
        for wrong in wrong.into_iter().chain(["Bearer 0123456789abcdef0", "Bearer  0123456789abcdef"]) {
            assert_eq!(name(&tokens, wrong), None, "{wrong}");
        }
        assert!(tokens.check(None).is_err());
        assert_eq!(Tokens::default().check(None).map(|tenant| tenant.name().len()).ok(), Some(0));
        assert_eq!(
            name(&Tokens::single(LIGHT).expect("sound"), &format!("Bearer {LIGHT}")).as_deref(),
            Some("default")
        );
    }

    #[test]
    fn a_wrong_file_is_named_with_its_line_and_no_token_is_ever_shown() {
        let long = "x".repeat(65);
        let wrong = [
            (format!("light {LIGHT}\nlight"), "line 2: has 1 words"),
            (format!("light {LIGHT} more"), "line 1: has 3 words"),
            ("light short".into(), "line 1: the token has 5 bytes, expected 16"),
            (format!("li/ght {LIGHT}"), "line 1: the name is not"),
            (format!("{long} {LIGHT}"), "line 1: the name is not"),
            (format!("light {LIGHT}é"), "line 1: the token has bytes"),
            (format!("light {LIGHT}\n\ncomp {LIGHT}"), "line 3: the token of comp is also that of light"),
            ("# none\n".into(), "no tokens"),
        ];
        for (text, what) in wrong {
            let file = file(0o600, &text);
            let error = Tokens::load(file.path()).expect_err(what);
            assert!(error.contains(what) && error.contains(&file.path().display().to_string()), "{error}");
            assert!(!error.contains(LIGHT) && !error.contains("short") && !error.contains('\n'), "{error}");
        }
        let open = file(0o640, &format!("light {LIGHT}"));
        let error = Tokens::load(open.path()).expect_err("open");
        assert!(error.contains(&format!("chmod 600 {}", open.path().display())), "{error}");
        let tokens = Tokens::single(LIGHT).expect("sound");
        assert_eq!(format!("{tokens:?}"), r#"[Tenant("default")]"#);
        assert!(!Tokens::single("too-short").expect_err("short").contains("too-short"));
    }
}
