//! Pictures from a socket of this machine: the mock's.

use crate::source::{offset_ns, Picture, PictureRequest, PictureSource, SourceKind};
use dpm_device::picture_stream::{PictureHeader, HEADER_BYTES, MAGIC};
use dpm_device::time::{HostClock, HostTime};
use std::io::{ErrorKind, Read};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A server on a socket.
pub(crate) static KIND: SourceKind = SourceKind {
    place: |device| device.strip_prefix("tcp:"),
    form: "\"tcp:HOST:PORT\" of `hil-mock serve camera`",
    open,
    examine: None,
};

fn open(
    place: &str,
    request: &PictureRequest,
    clock: &Arc<dyn HostClock>,
) -> Result<Box<dyn PictureSource>, String> {
    if request.exposure_us.is_some() || request.gain.is_some() || request.readout_us > 0 {
        let own = "its pictures say how they were exposed";
        return Err(format!("{own}: leave out tracker.exposure_us, tracker.gain and tracker.readout_us"));
    }
    let found = place.to_socket_addrs().ok().and_then(|mut all| all.next());
    let address = found.ok_or_else(|| format!("{place:?} is no HOST:PORT"))?;
    Ok(Box::new(StreamSource::new(address, clock)))
}

/// How long a connection may take.
const CONNECT: Duration = Duration::from_millis(500);

/// A client of [`dpm_device::picture_stream`]. It connects when it is asked for a picture, and again after every loss.
pub(crate) struct StreamSource {
    address: SocketAddr,
    name: String,
    /// The host's clock less CLOCK_MONOTONIC, ns.
    offset_ns: i64,
    stream: Option<TcpStream>,
    /// What has come of the next picture: its header, then its pixels.
    bytes: Vec<u8>,
}

impl StreamSource {
    /// A client of the server at `address`, whose stamps go onto `clock`.
    fn new(address: SocketAddr, clock: &Arc<dyn HostClock>) -> Self {
        let (name, offset_ns) = (format!("tcp:{address}"), offset_ns(&**clock));
        Self { address, name, offset_ns, stream: None, bytes: Vec::new() }
    }

    fn connected(&mut self) -> Result<&mut TcpStream, String> {
        if self.stream.is_none() {
            let told = |e: std::io::Error| {
                format!("no camera at {}: {e}; is `hil-mock serve camera` running?", self.address)
            };
            let stream = TcpStream::connect_timeout(&self.address, CONNECT).map_err(told)?;
            self.bytes.clear();
            self.stream = Some(stream);
        }
        Ok(self.stream.as_mut().expect("just connected"))
    }

    /// How many bytes are missing to the end of the header or of the picture; `None` if the header is none.
    fn missing(&self) -> Option<usize> {
        let Some(header) = self.bytes.first_chunk::<HEADER_BYTES>() else {
            return Some(HEADER_BYTES - self.bytes.len());
        };
        let whole = HEADER_BYTES + PictureHeader::decode(header)?.pixel_bytes();
        Some(whole - self.bytes.len())
    }
}

impl PictureSource for StreamSource {
    fn next(&mut self, timeout: Duration, picture: &mut Picture) -> Result<bool, String> {
        let begin = Instant::now();
        loop {
            let Some(missing) = self.missing() else {
                self.stream = None;
                self.bytes.clear();
                return Err(format!(
                    "{} sends no pictures (they begin with {:?})",
                    self.address,
                    MAGIC.escape_ascii().to_string()
                ));
            };
            let header = self.bytes.first_chunk::<HEADER_BYTES>().and_then(PictureHeader::decode);
            if let (0, Some(header)) = (missing, header) {
                fill(&header, &self.bytes[HEADER_BYTES..], self.offset_ns, picture);
                self.bytes.clear();
                return Ok(true);
            }
            let left = timeout.saturating_sub(begin.elapsed());
            if left.is_zero() {
                return Ok(false);
            }
            let mut part = [0; 1 << 16];
            let stream = self.connected()?;
            let got = stream
                .set_read_timeout(Some(left.max(Duration::from_millis(1))))
                .and_then(|()| stream.read(&mut part[..missing.min(1 << 16)]));
            match got {
                Ok(0) => {
                    self.stream = None;
                    return Err(format!("the camera at {} closed the connection", self.address));
                }
                Ok(n) => self.bytes.extend_from_slice(&part[..n]),
                Err(e)
                    if [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted]
                        .contains(&e.kind()) => {}
                Err(e) => {
                    self.stream = None;
                    return Err(format!("the camera at {}: {e}", self.address));
                }
            }
        }
    }

    fn name(&self) -> &str {
        &self.name
    }
}

fn fill(header: &PictureHeader, pixels: &[u8], offset_ns: i64, picture: &mut Picture) {
    picture.width = header.width as usize;
    picture.height = header.height as usize;
    picture.pixels.clear();
    picture.pixels.extend_from_slice(pixels);
    picture.number = header.number;
    picture.begin = HostTime(header.begin_ns.saturating_add(offset_ns));
    (picture.exposure_ns, picture.row_ns) = (header.exposure_ns, header.row_ns);
}
