//! Who calls.

use std::sync::Arc;

/// Whose namespaces a call may use: the name of its token, empty on servers without tokens.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
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

impl Default for Tenant {
    fn default() -> Self {
        Self("".into())
    }
}

/// Who calls.
pub fn tenant<T>(request: &tonic::Request<T>) -> Tenant {
    request.extensions().get().cloned().unwrap_or_default()
}
