//! The messages besides frames: connecting, server information, echo, requests, keep-alive.

use super::wire::{begin, finish, id, Reader, Version, WireError};

/// Longest name in a connect or server-information message, its zero included.
pub const NAME_BYTES: usize = 256;
/// Payload of a server-information message since NatNet 3.0.
pub const SERVER_INFO_BYTES: usize = 279;

/// Information about a server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerInfo {
    /// Name of the program, up to its first zero (Motive leaves stale bytes after it).
    pub name: String,
    /// Version of the program.
    pub app_version: [u8; 4],
    /// Version of the bit stream: `major, minor, build, revision`.
    pub natnet_version: [u8; 4],
    /// Rate of the clock of the mid-exposure and echo stamps, ticks per second. 0 if the server does not say.
    pub clock_hz: u64,
    /// Port of the frames.
    pub data_port: u16,
    /// Whether frames go to a multicast group, and which.
    pub multicast: Option<[u8; 4]>,
}

impl ServerInfo {
    /// Reads a server-information payload. Servers before 3.0 send fewer bytes; their version distinguishes them.
    pub fn decode(payload: &[u8]) -> Result<Self, WireError> {
        let mut r = Reader::new(payload);
        let name = r.take(NAME_BYTES, "server name")?;
        let end = name.iter().position(|b| *b == 0).unwrap_or(NAME_BYTES);
        let name = String::from_utf8_lossy(&name[..end]).into_owned();
        let four = |b: &[u8]| [b[0], b[1], b[2], b[3]];
        let app_version = four(r.take(4, "server version")?);
        let natnet_version = four(r.take(4, "NatNet version")?);
        let version = Version::new(natnet_version[0], natnet_version[1]);
        if !version.is_spoken() {
            return Err(WireError::Version(version));
        }
        let clock_hz = r.u64("clock frequency")?;
        let data_port = r.u16("data port")?;
        let is_multicast = r.u8("multicast flag")? != 0;
        let group = four(r.take(4, "multicast group")?);
        Ok(Self {
            name,
            app_version,
            natnet_version,
            clock_hz,
            data_port,
            multicast: is_multicast.then_some(group),
        })
    }

    /// Version of the bit stream.
    pub fn version(&self) -> Version {
        Version::new(self.natnet_version[0], self.natnet_version[1])
    }

    /// Writes the message into `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        begin(out, id::SERVER_INFO);
        push_name(out, &self.name);
        out.extend_from_slice(&self.app_version);
        out.extend_from_slice(&self.natnet_version);
        out.extend_from_slice(&self.clock_hz.to_le_bytes());
        out.extend_from_slice(&self.data_port.to_le_bytes());
        out.push(u8::from(self.multicast.is_some()));
        out.extend_from_slice(&self.multicast.unwrap_or_default());
        finish(out).expect("279 bytes fit a datagram");
    }
}

/// A client's connect message. Clients in the field send nothing, `Ping\0`, 264 or 270 bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Connect {
    /// Name of the program, empty when it gives none.
    pub name: String,
    /// Requested bit stream (270-byte form only).
    pub bitstream: Option<Version>,
}

impl Connect {
    /// Reads any of the four forms; a message shorter than 264 bytes has no content.
    pub fn decode(payload: &[u8]) -> Self {
        if payload.len() < 264 {
            return Self::default();
        }
        let end = payload[..NAME_BYTES].iter().position(|b| *b == 0).unwrap_or(NAME_BYTES);
        let name = String::from_utf8_lossy(&payload[..end]).into_owned();
        let bitstream = payload.get(265..269).map(|v| Version::new(v[0], v[1])).filter(|v| v.is_spoken());
        Self { name, bitstream }
    }

    /// Writes the 270-byte form into `out`.
    pub fn encode(&self, out: &mut Vec<u8>) {
        begin(out, id::CONNECT);
        push_name(out, &self.name);
        out.extend_from_slice(&[1, 0, 0, 0]);
        out.extend_from_slice(&[Version::V4_2.major, Version::V4_2.minor, 0, 0]);
        out.push(0);
        let wanted = self.bitstream.unwrap_or(Version::new(0, 0));
        out.extend_from_slice(&[wanted.major, wanted.minor, 0, 0]);
        out.push(0);
        finish(out).expect("270 bytes fit a datagram");
    }
}

fn push_name(out: &mut Vec<u8>, name: &str) {
    let mut bytes = [0; NAME_BYTES];
    let n = name.len().min(NAME_BYTES - 1);
    bytes[..n].copy_from_slice(&name.as_bytes()[..n]);
    out.extend_from_slice(&bytes);
}

/// Writes a message without payload (model-definition request, keep-alive, disconnect) into `out`.
pub fn encode_empty(out: &mut Vec<u8>, id: u16) {
    begin(out, id);
}

/// Writes a request text (`Bitstream,4.1`) into `out`; cut at 1,024 bytes.
pub fn encode_request(out: &mut Vec<u8>, text: &str) {
    begin(out, id::REQUEST);
    out.extend_from_slice(&text.as_bytes()[..text.len().min(1024)]);
    out.push(0);
    finish(out).expect("at most 1,025 bytes");
}

/// The text of a request, without its zero; `None` when it is not UTF-8.
pub fn request_text(payload: &[u8]) -> Option<&str> {
    let end = payload.iter().position(|b| *b == 0).unwrap_or(payload.len());
    core::str::from_utf8(&payload[..end]).ok()
}

/// Writes an echo request carrying the client's own stamp.
pub fn encode_echo_request(out: &mut Vec<u8>, client_stamp: u64) {
    begin(out, id::ECHO_REQUEST);
    out.extend_from_slice(&client_stamp.to_le_bytes());
    finish(out).expect("8 bytes");
}

/// Writes the answer to an echo request.
pub fn encode_echo_response(out: &mut Vec<u8>, client_stamp: u64, server_ticks: u64) {
    begin(out, id::ECHO_RESPONSE);
    out.extend_from_slice(&client_stamp.to_le_bytes());
    out.extend_from_slice(&server_ticks.to_le_bytes());
    finish(out).expect("16 bytes");
}

/// The client's stamp in an echo request.
pub fn decode_echo_request(payload: &[u8]) -> Result<u64, WireError> {
    Reader::new(payload).u64("client stamp")
}

/// The client's stamp and the server's ticks in an echo response.
pub fn decode_echo_response(payload: &[u8]) -> Result<(u64, u64), WireError> {
    let mut r = Reader::new(payload);
    Ok((r.u64("client stamp")?, r.u64("server ticks")?))
}
