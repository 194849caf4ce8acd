//! From a request to its answer.

use crate::calibration::{self, Guide};
use crate::connections::{Connection, Doing};
use crate::events::Events;
use crate::guard::{RequestRefusal, PROOF};
use crate::metrics;
use crate::orders;
use crate::parameters;
use crate::proof::is_number;
use crate::query::part;
use crate::rigs::Rigs;
use crate::shared::RunView;
use crate::site::{Serves, Site};
use crate::state::RigState;
use base64::prelude::{Engine, BASE64_STANDARD};
use dpm_device::regular_file;
use dpm_rig::order::Order;
use dpm_rig::telemetry::flight::page_path;
use hyper::body::{Body, Bytes, Frame, Incoming, SizeHint};
use hyper::header::{self, HeaderName, HeaderValue};
use hyper::{Method, Request, Response, StatusCode};
use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

/// The live page, that of a calibration, and the overview of several rigs. Scripts and styles are marked with a number
/// that is drawn for each answer.
const PAGE: &str = include_str!("page.html");
const CALIBRATION: &str = include_str!("calibration.html");
const RIGS: &str = include_str!("rigs/rigs.html");
/// What stands for that number in a page, and for what pages share.
const NONCE: &str = "{{nonce}}";
const SHARED: [(&str, &str); 4] = [
    ("{{style}}", include_str!("shared.css")),
    ("{{script}}", include_str!("shared.js")),
    ("{{key}}", include_str!("key.js")),
    ("{{room}}", include_str!("room.js")),
];
/// Longest page of a flight, bytes.
const MAX_FLIGHT_BYTES: u64 = 1 << 20;
/// How long the metrics wait for fresh figures.
const FRESH_WITHIN: Duration = Duration::from_millis(60);

/// The body of an answer.
pub(crate) enum HttpBody {
    /// All of it.
    Whole(Option<Bytes>),
    /// The rig's events, without end.
    Events(Box<Events>),
}

impl Body for HttpBody {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        match self.get_mut() {
            Self::Whole(bytes) => Poll::Ready(bytes.take().map(|bytes| Ok(Frame::data(bytes)))),
            Self::Events(events) => events.poll_next(cx).map(|bytes| Some(Ok(Frame::data(bytes)))),
        }
    }

    fn is_end_stream(&self) -> bool {
        matches!(self, Self::Whole(None))
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(bytes) => SizeHint::with_exact(bytes.as_ref().map_or(0, |b| b.len() as u64)),
            Self::Events(_) => SizeHint::default(),
        }
    }
}

fn whole(status: StatusCode, kind: &'static str, text: impl Into<Bytes>) -> Response<HttpBody> {
    let mut response = Response::new(HttpBody::Whole(Some(text.into())));
    *response.status_mut() = status;
    response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    response
}

fn plain(status: StatusCode, text: impl Into<String>) -> Response<HttpBody> {
    whole(status, "text/plain; charset=utf-8", text.into() + "\n")
}

fn json(status: StatusCode, value: &impl serde::Serialize) -> Response<HttpBody> {
    whole(status, "application/json", serde_json::to_string(value).unwrap_or_default())
}

fn refusal(refused: RequestRefusal) -> Response<HttpBody> {
    plain(StatusCode::from_u16(refused.status).unwrap_or(StatusCode::FORBIDDEN), refused.told)
}

/// Answers a request.
///
/// # Errors
/// Never; a client that went away ends this future.
pub(crate) async fn answer(
    request: Request<Incoming>,
    connection: Arc<Connection>,
    site: Arc<Site>,
) -> Result<Response<HttpBody>, Infallible> {
    connection.now_does(Doing::Asks);
    let mut response = match site.door.guard.check(request.headers()) {
        Err(refused) => {
            tokio::time::sleep(site.door.pace()).await;
            refusal(refused)
        }
        Ok(()) => route(&request, &connection, &site).await,
    };
    if let HttpBody::Whole(Some(body)) = response.body() {
        let proof = site.door.guard.proof(&request, response.status().as_u16(), body);
        if let Some(proof) = proof.and_then(|proof| HeaderValue::from_str(&proof).ok()) {
            response.headers_mut().insert(PROOF, proof);
        }
    }
    if !matches!(response.body(), HttpBody::Events(_)) {
        connection.now_does(Doing::Nothing);
    }
    // No answer needs the body of its request. One that has a body ends the connection, so that nobody has to read it.
    if !request.body().is_end_stream() {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    for (name, value) in [
        (header::CACHE_CONTROL, "no-store"),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (HeaderName::from_static("cross-origin-opener-policy"), "same-origin"),
    ] {
        response.headers_mut().insert(name, HeaderValue::from_static(value));
    }
    Ok(response)
}

async fn route(
    request: &Request<Incoming>,
    connection: &Arc<Connection>,
    site: &Arc<Site>,
) -> Response<HttpBody> {
    let path = request.uri().path();
    if let (Some(word), Some(run)) = (path.strip_prefix("/api/orders/"), site.serves.run()) {
        return order(request, word, connection, (site, run)).await;
    }
    if path == "/api/challenge" && request.method() == Method::GET {
        // An order waits for it.
        return match site.door.guard.challenge() {
            Ok(challenge) => whole(StatusCode::OK, "text/plain; charset=utf-8", challenge),
            Err(refused) => refusal(refused),
        };
    }
    tokio::time::sleep(site.door.pace()).await;
    match &site.serves {
        Serves::Run(run, guide) => of_rig(request, connection, site, (guide, Some(run))).await,
        Serves::Calibration(guide) => of_rig(request, connection, site, (guide, None)).await,
        Serves::Rigs(rigs) => of_rigs(request, rigs),
    }
}

/// What there is of one rig: the steps of its calibration, and its run where it runs.
async fn of_rig(
    request: &Request<Incoming>,
    connection: &Arc<Connection>,
    site: &Arc<Site>,
    (guide, run): (&Arc<dyn Guide>, Option<&Arc<RunView>>),
) -> Response<HttpBody> {
    let path = request.uri().path();
    if let (Some(word), Some(run)) = (path.strip_prefix("/api/parameters/"), run) {
        return change(request, word, (site, run)).await;
    }
    if let Some(word) = path.strip_prefix("/api/calibration/") {
        return calibrate(request, word, (site, guide)).await;
    }
    if request.method() != Method::GET {
        return plain(StatusCode::METHOD_NOT_ALLOWED, "only GET, and POST for orders and parameters");
    }
    match (path, run) {
        ("/calibration", _) | ("/", None) => page(CALIBRATION),
        ("/api/calibration", _) => match calibration::told(guide, run.is_some()).await {
            Some(told) => json(StatusCode::OK, &told),
            None => plain(StatusCode::INTERNAL_SERVER_ERROR, "the calibration file could not be read"),
        },
        ("/api/key", _) => match site.door.guard.check_order(request) {
            Ok(()) => plain(StatusCode::OK, "ok"),
            Err(refused) => refusal(refused),
        },
        ("/favicon.ico", _) => plain(StatusCode::NOT_FOUND, "none"),
        (_, Some(run)) => of_run(request, connection, (site, run)).await,
        _ => plain(StatusCode::NOT_FOUND, "there is / and /api/calibration"),
    }
}

/// What there is of several rigs.
fn of_rigs(request: &Request<Incoming>, rigs: &Rigs) -> Response<HttpBody> {
    if request.method() != Method::GET {
        return plain(StatusCode::METHOD_NOT_ALLOWED, "only GET; orders are given on the rigs' own pages");
    }
    match request.uri().path() {
        "/" => page(RIGS),
        "/api/rigs" => json(StatusCode::OK, &rigs.look()),
        _ => plain(StatusCode::NOT_FOUND, "there is / and /api/rigs"),
    }
}

/// What there is to see of a run.
async fn of_run(
    request: &Request<Incoming>,
    connection: &Arc<Connection>,
    (site, shared): (&Arc<Site>, &Arc<RunView>),
) -> Response<HttpBody> {
    let path = request.uri().path();
    match path {
        "/" => page(PAGE),
        "/metrics" => {
            let text = metrics::text(&fresh(shared).await);
            whole(StatusCode::OK, "text/plain; version=0.0.4; charset=utf-8", text)
        }
        "/api/state" => json(StatusCode::OK, &fresh(shared).await.to_json()),
        "/api/parameters" => json(StatusCode::OK, &shared.monitor.parameters().shown()),
        "/api/room" => match shared.monitor.live().rig() {
            Some(rig) => {
                // A scan of a million triangles takes a moment, and an order must not wait for it.
                let (shared, rig) = (shared.clone(), rig.clone());
                let made = tokio::task::spawn_blocking(move || {
                    shared.room.get_or_init(|| crate::room::shapes(&rig)).clone()
                });
                match made.await {
                    Ok(shapes) => json(StatusCode::OK, &shapes),
                    Err(_) => plain(StatusCode::SERVICE_UNAVAILABLE, "the program ends"),
                }
            }
            None => plain(StatusCode::SERVICE_UNAVAILABLE, "the run has not begun"),
        },
        "/api/events" => match shared.viewer() {
            Some(viewer) => {
                connection.now_does(Doing::Views);
                let mut response = Response::new(HttpBody::Events(Box::new(Events::new(
                    viewer,
                    number_of(request).map(|number| (site.clone(), number)),
                ))));
                let kind = HeaderValue::from_static("text/event-stream");
                response.headers_mut().insert(header::CONTENT_TYPE, kind);
                response
            }
            None => {
                plain(StatusCode::SERVICE_UNAVAILABLE, "too many viewers: close another page of this rig")
            }
        },
        _ if path.starts_with("/api/flights/") => flight(path, shared).await,
        _ => {
            let known = "there is /, /calibration, /metrics, /api/state, /api/room, /api/parameters, /api/calibration and /api/events";
            plain(StatusCode::NOT_FOUND, known)
        }
    }
}

/// The number for which a viewer wants its events proven.
fn number_of(request: &Request<Incoming>) -> Option<String> {
    part(request.uri().query().unwrap_or_default(), "number").filter(|number| is_number(number))
}

async fn order(
    request: &Request<Incoming>,
    word: &str,
    connection: &Arc<Connection>,
    (site, shared): (&Site, &Arc<RunView>),
) -> Response<HttpBody> {
    if let Err(refused) = site.door.guard.check_order(request) {
        tokio::time::sleep(site.door.pace()).await;
        return refusal(refused);
    }
    if request.method() != Method::POST {
        return plain(StatusCode::METHOD_NOT_ALLOWED, "an order is a POST");
    }
    let Some((order, _)) = Order::ALL.into_iter().find(|(_, known)| *known == word) else {
        let known: Vec<_> = Order::ALL.iter().map(|(_, word)| *word).collect();
        return plain(StatusCode::NOT_FOUND, format!("unknown order; known: {}", known.join(", ")));
    };
    connection.now_does(Doing::Orders);
    json(StatusCode::OK, &orders::give(order, shared).await)
}

/// A change of the parameters. It is signed as an order is, but it has waited its turn as every other request.
async fn change(
    request: &Request<Incoming>,
    word: &str,
    (site, shared): (&Site, &Arc<RunView>),
) -> Response<HttpBody> {
    if let Err(refused) = site.door.guard.check_order(request) {
        return refusal(refused);
    }
    if request.method() != Method::POST {
        return plain(StatusCode::METHOD_NOT_ALLOWED, "a change is a POST");
    }
    let Some(asked) = parameters::asked(word, request.uri().query().unwrap_or_default()) else {
        return plain(StatusCode::NOT_FOUND, "there is set, undo and save");
    };
    let done = match &asked {
        Ok(command) => parameters::give(command, shared).await,
        Err(refused) => Err(refused.clone()),
    };
    match done {
        Ok(answered) => json(StatusCode::OK, &answered),
        Err(refused) => plain(StatusCode::BAD_REQUEST, format!("refused: {refused}")),
    }
}

/// An act of a calibration, by whoever knows the secret.
async fn calibrate(
    request: &Request<Incoming>,
    word: &str,
    (site, guide): (&Site, &Arc<dyn Guide>),
) -> Response<HttpBody> {
    if let Err(refused) = site.door.guard.check_order(request) {
        return refusal(refused);
    }
    if request.method() != Method::POST {
        return plain(StatusCode::METHOD_NOT_ALLOWED, "an act of a calibration is a POST");
    }
    match calibration::act(word, request.uri().query().unwrap_or_default(), guide).await {
        Some(Ok(())) => plain(StatusCode::OK, "ok"),
        Some(Err(why)) => plain(StatusCode::BAD_REQUEST, why),
        None => plain(StatusCode::NOT_FOUND, "there is start, answer, stop, keep and discard"),
    }
}

/// The page of the flight recorder about a flight.
async fn flight(path: &str, shared: &Arc<RunView>) -> Response<HttpBody> {
    let number = path.rsplit('/').next().and_then(|number| number.parse().ok());
    let rig = shared.monitor.live().rig().filter(|rig| rig.config.output.flight_recorder);
    let Some(file) = rig.zip(number).and_then(|(rig, number)| page_path(&rig.config.output.dir, number))
    else {
        return plain(StatusCode::NOT_FOUND, "there is no such flight; output.flight_recorder records them");
    };
    // The disk may be slow, and an order must not wait for it.
    let read = tokio::task::spawn_blocking(move || regular_file::read_text(&file, MAX_FLIGHT_BYTES));
    match read.await {
        Ok(Ok(text)) => whole(StatusCode::OK, "text/plain; charset=utf-8", text),
        _ => plain(StatusCode::NOT_FOUND, "this flight was not written, or not yet"),
    }
}

/// The state with figures that were made for this request, if they come at once.
async fn fresh(shared: &Arc<RunView>) -> RigState {
    let live = shared.monitor.live();
    let before = live.snapshot();
    live.look();
    let begin = tokio::time::Instant::now();
    while begin.elapsed() < FRESH_WITHIN {
        let now = live.snapshot();
        let is_new = now.as_ref().map(Arc::as_ptr) != before.as_ref().map(Arc::as_ptr);
        if is_new || now.is_some_and(|s| s.is_final) {
            break;
        }
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    RigState::of(shared)
}

/// A page of this program, which loads nothing and runs nothing but what stands in it.
fn page(text: &str) -> Response<HttpBody> {
    let mut bytes = [0u8; 16];
    if getrandom::fill(&mut bytes).is_err() {
        return plain(StatusCode::SERVICE_UNAVAILABLE, "the operating system gave no random bytes");
    }
    let nonce = BASE64_STANDARD.encode(bytes);
    let text = SHARED.iter().fold(text.to_owned(), |text, (mark, part)| text.replacen(mark, part, 1));
    let text = text.replace(NONCE, &nonce);
    let policy = format!(
        "default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src data:; connect-src 'self'; \
         base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    );
    let mut response = whole(StatusCode::OK, "text/html; charset=utf-8", text);
    if let Ok(policy) = HeaderValue::from_str(&policy) {
        response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    }
    response
}
