//! What every call passes before its service sees it: it gets a number for the logs, and must be let in.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::header::AUTHORIZATION;
use tonic::codegen::http::{HeaderMap, HeaderValue, Request, Response};
use tonic::codegen::{BoxFuture, Service};
use tower::Layer;
use tracing::Instrument as _;

use crate::access::{Shown, Tenant, Tokens};
use crate::door::Pass;
use crate::inflow::{Holding, Inflow};
use crate::metrics;
use crate::refusal::{Refusal, same_version};

/// Names one call in logs and answers: the client's own, or a number.
const REQUEST_ID: &str = "x-request-id";

/// Longest request id that is taken from a client, bytes.
const REQUEST_ID_MAX: usize = 64;

/// Lets calls in. One for all sockets of a server.
#[derive(Clone, Debug)]
pub struct Gate {
    tokens: Arc<Tokens>,
    inflow: Arc<Inflow>,
    calls: Arc<AtomicU64>,
}

impl Gate {
    /// A gate that asks for one of `tokens`, if there are any, and lets messages of `inflow` bytes come at a time.
    pub fn new(tokens: Tokens, inflow: usize) -> Self {
        Self { tokens: Arc::new(tokens), inflow: Arc::new(Inflow::new(inflow)), calls: Arc::default() }
    }

    /// Whether a call may be made: it shows a token that is asked for, and is not of another build. Then its request carries its [`Tenant`], and is counted.
    fn admit(&self, mut request: Request<Body>) -> Result<Request<Body>, Refusal> {
        let pass = request.extensions().get::<Pass>().cloned();
        let holding = pass.as_ref().map_or_else(Holding::default, |pass| pass.holding().clone());
        if !is_open(request.uri().path()) {
            if let Some(most) = pass.as_ref().and_then(Pass::full) {
                return Err(Refusal::Connections(most));
            }
            let authorization = request.headers_mut().remove(AUTHORIZATION);
            let tenant = self.tokens.check(authorization.as_ref().map(HeaderValue::as_bytes))?;
            if let Some(version) = request.headers().get(cache_proto::VERSION_KEY) {
                same_version(&String::from_utf8_lossy(version.as_bytes()))?;
            }
            tracing::Span::current().record("tenant", tenant.name());
            request.extensions_mut().insert::<Tenant>(tenant);
            request.extensions_mut().insert(Shown(authorization));
            if let Some(pass) = pass {
                pass.stay();
            }
        }
        let inflow = self.inflow.clone();
        Ok(request.map(|body| inflow.count(holding, body)))
    }

    fn request_id(&self, headers: &HeaderMap) -> HeaderValue {
        let sane = |id: &&HeaderValue| {
            let id = id.as_bytes();
            let sound = |byte: &u8| byte.is_ascii_alphanumeric() || b"._-:".contains(byte);
            (1..=REQUEST_ID_MAX).contains(&id.len()) && id.iter().all(sound)
        };
        let own = || self.calls.fetch_add(1, Ordering::Relaxed).into();
        headers.get(REQUEST_ID).filter(sane).cloned().unwrap_or_else(own)
    }
}

/// Whether anybody may call it: probes of health carry no tokens. A connection does not stay for them alone.
fn is_open(path: &str) -> bool {
    path.starts_with("/grpc.health.v1.Health/")
}

impl<S> Layer<S> for Gate {
    type Service = Gated<S>;

    fn layer(&self, inner: S) -> Gated<S> {
        Gated { gate: self.clone(), inner }
    }
}

/// Services behind a [`Gate`].
#[derive(Clone, Debug)]
pub struct Gated<S> {
    gate: Gate,
    inner: S,
}

impl<S> Service<Request<Body>> for Gated<S>
where
    S: Service<Request<Body>, Response = Response<Body>, Error = Infallible>,
    S::Future: Send + 'static,
{
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Response<Body>, Infallible>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let method = metrics::method(request.uri().path());
        let id = self.gate.request_id(request.headers());
        let shown = id.to_str().unwrap_or_default();
        let span = tracing::info_span!("call", method, request = shown, tenant = tracing::field::Empty);
        let answer = span.in_scope(|| self.gate.admit(request)).map(|request| self.inner.call(request));
        let answered = async move {
            let mut response = match answer {
                Ok(answer) => answer.await?,
                Err(refusal) => Status::from(refusal).into_http(),
            };
            if let Some(status) = Status::from_header_map(response.headers()).filter(|s| s.code() != tonic::Code::Ok) {
                tracing::info!(code = ?status.code(), reason = status.message(), "refused");
                metrics::refused(method, status.code());
            }
            response.headers_mut().insert(REQUEST_ID, id);
            Ok(response)
        };
        metrics::called(method);
        Box::pin(answered.instrument(span))
    }
}
