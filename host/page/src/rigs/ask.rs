//! One question to a rig's page, and why there was no answer.

use super::address::RigAddress;
use super::told::StateAnswer;
use crate::connections::Connection;
use crate::stream::WatchedSocket;
use hyper::body::Body;
use hyper::client::conn::http1;
use hyper::{header, Request, StatusCode};
use std::future::poll_fn;
use std::io;
use std::pin::Pin;
use std::time::Duration;
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio::time::timeout;

/// How long a connection and an answer may take.
const CONNECT_WITHIN: Duration = Duration::from_secs(1);
const ANSWER_WITHIN: Duration = Duration::from_secs(2);
/// Longest head of an answer, bytes. (The library takes no less.)
const HEAD_BYTES: usize = 8192;
/// Longest body of an answer, bytes. A rig with the most bodies that there may be needs a third of it.
const BODY_BYTES: usize = 256 * 1024;

/// Why a rig has not told its state, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub(super) enum AskError {
    #[error("nobody listens there; start the rig with --page at this address, or the tunnel to it")]
    Refused,
    #[error("no connection: {0}")]
    Connect(io::Error),
    #[error("no connection within {} s; look at the rig's machine, or at the tunnel", CONNECT_WITHIN.as_secs())]
    Unconnected,
    #[error("no answer within {} s; the rig hangs, or the tunnel to it", ANSWER_WITHIN.as_secs())]
    Slow,
    #[error(
        "the connection ended without a whole answer; behind a tunnel this means that the rig does not run"
    )]
    Ended,
    #[error(
        "what answers there does not answer to {0} (status 421), so it is no rig's page; check the port"
    )]
    Misdirected(String),
    #[error("no run is shown there (status 404): it is another page or another program; start the rig with --page")]
    NoRun,
    #[error("it answered with status {0} instead of its state; look at the rig's own page")]
    Status(u16),
    #[error("what answers there does not speak HTTP; check the port")]
    NotHttp,
    #[error("its answer is longer than {} KiB, so it is no rig's; check the port", BODY_BYTES / 1024)]
    TooLong,
    #[error(
        "its answer is not the state of a rig; check the port, and that both programs have the same version"
    )]
    NotState,
}

impl From<hyper::Error> for AskError {
    fn from(e: hyper::Error) -> Self {
        if e.is_parse() {
            Self::NotHttp
        } else {
            Self::Ended
        }
    }
}

/// Asks a rig for its state.
pub(super) async fn ask(rig: &RigAddress) -> Result<StateAnswer, AskError> {
    let stream = match timeout(CONNECT_WITHIN, TcpStream::connect(rig.address())).await {
        Ok(Ok(stream)) => stream,
        Ok(Err(e)) if e.kind() == io::ErrorKind::ConnectionRefused => return Err(AskError::Refused),
        Ok(Err(e)) => return Err(AskError::Connect(e)),
        Err(_) => return Err(AskError::Unconnected),
    };
    let body = timeout(ANSWER_WITHIN, exchange(stream, rig.host())).await.map_err(|_| AskError::Slow)??;
    serde_json::from_slice(&body).map_err(|_| AskError::NotState)
}

/// Asks over `stream` for the state of the rig that answers to `host`, and returns the body of the answer.
async fn exchange(stream: TcpStream, host: String) -> Result<Vec<u8>, AskError> {
    let _ = stream.set_nodelay(true);
    let stream = WatchedSocket::new(stream, Connection::new());
    let (mut sender, connection) =
        http1::Builder::new().max_buf_size(HEAD_BYTES).handshake::<_, String>(stream).await?;
    // It carries the exchange, and ends with this future, whatever ends that.
    let mut carrier = JoinSet::new();
    carrier.spawn(connection);
    let request = Request::get("/api/state")
        .header(header::HOST, &host)
        .header(header::CONNECTION, "close")
        .body(String::new())
        .map_err(|_| AskError::Misdirected(host.clone()))?;
    let response = sender.send_request(request).await?;
    match response.status() {
        StatusCode::OK => {}
        StatusCode::MISDIRECTED_REQUEST => return Err(AskError::Misdirected(host)),
        StatusCode::NOT_FOUND => return Err(AskError::NoRun),
        status => return Err(AskError::Status(status.as_u16())),
    }
    let (mut body, mut bytes) = (response.into_body(), Vec::new());
    while let Some(frame) = poll_fn(|cx| Pin::new(&mut body).poll_frame(cx)).await {
        let frame = frame?;
        let data = frame.data_ref().map_or(&[][..], |data| data);
        if bytes.len() + data.len() > BODY_BYTES {
            return Err(AskError::TooLong);
        }
        bytes.extend_from_slice(data);
    }
    Ok(bytes)
}
