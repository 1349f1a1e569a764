//! The `Frames` service of a relay: calls pass as they are, undecoded.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use http_body::Frame;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::http::header::{AUTHORIZATION, HeaderValue};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::codegen::http::{HeaderMap, Request, Response, Uri};
use tonic::codegen::{BoxFuture, Bytes, Service};
use tonic::server::NamedService;
use tower::ServiceExt as _;
use worker::credentials::RELAYS;

use super::{Above, Caller};

/// Passes calls up.
#[derive(Clone)]
pub struct Pass(pub Arc<Above>);

impl NamedService for Pass {
    const NAME: &'static str = "ambience.v1.Frames";
}

impl Service<Request<Body>> for Pass {
    type Response = Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Response<Body>, Infallible>;

    fn poll_ready(&mut self, _: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        Poll::Ready(Ok(()))
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let above = self.0.clone();
        Box::pin(async move {
            let caller = above.caller(request.extensions(), request.headers());
            let away = |error: tonic::transport::Error| away(&above, &error);
            let passed = match caller.and_then(|caller| relayed(request, &caller)) {
                Ok(request) => above.channel().oneshot(request).await.map_err(away),
                Err(status) => Err(status),
            };
            let passed = passed.map(|response| response.map(|body| Body::new(Answer(Some((body, above.clone()))))));
            Ok(passed.unwrap_or_else(Status::into_http))
        })
    }
}

/// The request as it goes up.
fn relayed(request: Request<Body>, caller: &Caller) -> Result<Request<Body>, Status> {
    let wrong = |_| Status::invalid_argument("a header that cannot be passed on");
    let (mut parts, body) = request.into_parts();
    let path = parts.uri.path_and_query().cloned().unwrap_or_else(|| PathAndQuery::from_static("/"));
    parts.uri = Uri::from(path);
    parts.extensions.clear();
    parts.headers.insert(RELAYS, HeaderValue::from_str(&caller.relays).map_err(wrong)?);
    if let Some(authorization) = &caller.authorization {
        let mut value = HeaderValue::from_bytes(authorization).map_err(wrong)?;
        value.set_sensitive(true);
        parts.headers.insert(AUTHORIZATION, value);
    }
    Ok(Request::from_parts(parts, body))
}

fn away(above: &Above, error: &dyn std::fmt::Display) -> Status {
    Status::unavailable(format!("the server above, {}: {error}", above.address))
}

/// What is answered. Where it breaks off, it ends with what a client knows as worth repeating; a stream that is merely cut
/// it would take for a fault of the protocol.
struct Answer(Option<(Body, Arc<Above>)>);

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let Some((body, above)) = &mut self.0 else { return Poll::Ready(None) };
        let error = match ready!(Pin::new(&mut *body).poll_frame(context)) {
            Some(Err(error)) => error,
            frame => return Poll::Ready(frame),
        };
        let mut trailers = HeaderMap::new();
        away(above, &error).add_header(&mut trailers)?;
        self.0 = None;
        Poll::Ready(Some(Ok(Frame::trailers(trailers))))
    }
}
