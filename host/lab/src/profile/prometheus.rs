//! Counters and distributions into the text page that Prometheus scrapes, and the smallest server that hands it out.
//!
//! Format: Prometheus text exposition, version 0.0.4. The server answers one request at a time with time limits, off the frame
//! path; it is for a trusted network and says nothing but figures.

use dpm_rig::telemetry::monitor::RunCounts;
use dpm_rig::telemetry::profile::ProfileReport;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

/// A page of a run's counters and, where there is one, its profile.
pub fn page(counts: &RunCounts, profile: Option<&ProfileReport>) -> String {
    let mut text = String::new();
    let mut counter = |name: &str, help: &str, value: u64| {
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "# HELP dpm_{name}_total {help}\n# TYPE dpm_{name}_total counter\ndpm_{name}_total {value}"
        );
    };
    counter("frames_planned", "Frames planned.", counts.frames_planned);
    counter("frames_lit", "Frames whose light left the projector, with light on a body.", counts.frames_lit);
    counter("frames_dark", "Frames that the projector lit in which every body was dark.", counts.frames_dark);
    counter("frames_dropped", "Frames that were planned and never lit.", counts.frames_dropped);
    counter("frames_withheld", "Frames not lit because no new picture was wanted.", counts.frames_withheld);
    counter("frames_late", "Frames lit after their slot.", counts.frames_late);
    counter("slots", "Slots in which a frame of their own was wanted.", counts.slots);
    counter("slots_missed", "Of these, slots without one, whatever the cause.", counts.slots_missed);
    let Some(profile) = profile else { return text };
    let mut labelled = |name: &str, help: &str, label: &str, values: &BTreeMap<String, u64>| {
        let _ = writeln!(text, "# HELP dpm_{name}_total {help}\n# TYPE dpm_{name}_total counter");
        for (value, n) in values {
            let _ = writeln!(text, "dpm_{name}_total{{{label}=\"{}\"}} {n}", escaped(value));
        }
    };
    labelled(
        "slots_missed_by_cause",
        "Slots without a frame of their own, by cause.",
        "cause",
        &profile.missed,
    );
    labelled(
        "slots_ordered_dark",
        "Slots in which no new picture was wanted, by reason.",
        "reason",
        &profile.ordered_dark,
    );
    let early = profile.intervals_ms.iter().map(|(name, d)| (name.clone(), d.negative)).collect();
    labelled("interval_negative", "Frames in which the interval was negative.", "interval", &early);
    text.push_str("# HELP dpm_interval_seconds Parts of a frame's way from sample to light, with their sign.\n# TYPE dpm_interval_seconds summary\n");
    for (name, d) in &profile.intervals_ms {
        let name = escaped(name);
        for (quantile, ms) in [("0.5", d.p50), ("0.9", d.p90), ("0.99", d.p99), ("0.999", d.p999)] {
            let _ = writeln!(
                text,
                "dpm_interval_seconds{{interval=\"{name}\",quantile=\"{quantile}\"}} {}",
                ms * 1e-3
            );
        }
        let _ = writeln!(
            text,
            "dpm_interval_seconds_sum{{interval=\"{name}\"}} {}",
            d.mean * 1e-3 * d.count as f64
        );
        let _ = writeln!(text, "dpm_interval_seconds_count{{interval=\"{name}\"}} {}", d.count);
    }
    text
}

/// Backslash, quote and line feed, as the format wants them in label values.
fn escaped(value: &str) -> String {
    value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

/// Serves the newest page on a port of its own.
#[derive(Debug)]
pub struct PageServer {
    page: Arc<Mutex<String>>,
    stop: Arc<AtomicBool>,
    address: SocketAddr,
    thread: Option<JoinHandle<()>>,
}

impl PageServer {
    /// Listens on `address` (port 0: any free one).
    pub fn start(address: impl ToSocketAddrs) -> std::io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let page = Arc::new(Mutex::new(String::new()));
        let stop = Arc::new(AtomicBool::new(false));
        let (shown, ended) = (page.clone(), stop.clone());
        let thread = std::thread::Builder::new().name("prometheus".into()).spawn(move || {
            for stream in listener.incoming() {
                if ended.load(Ordering::Relaxed) {
                    break;
                }
                // A client that fails is the client's matter; scrapes repeat.
                let _ = stream.and_then(|s| answer(s, &shown));
            }
        })?;
        Ok(Self { page, stop, address, thread: Some(thread) })
    }

    /// Where it listens.
    #[cfg(test)]
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }

    /// Replaces the page. Called by the thread that watches the run, once a second or so.
    pub fn show(&self, text: String) {
        if let Ok(mut page) = self.page.lock() {
            *page = text;
        }
    }
}

impl Drop for PageServer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // Wakes the thread out of accept. A wildcard address is reached through loopback of its family.
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(match address {
                SocketAddr::V4(_) => std::net::Ipv4Addr::LOCALHOST.into(),
                SocketAddr::V6(_) => std::net::Ipv6Addr::LOCALHOST.into(),
            });
        }
        let woken = TcpStream::connect_timeout(&address, Duration::from_millis(200)).is_ok();
        if let (true, Some(thread)) = (woken, self.thread.take()) {
            let _ = thread.join();
        }
    }
}

/// Reads a request of at most 4 KiB in at most a second and answers it.
fn answer(mut stream: TcpStream, page: &Mutex<String>) -> std::io::Result<()> {
    stream.set_read_timeout(Some(Duration::from_millis(250)))?;
    stream.set_write_timeout(Some(Duration::from_secs(1)))?;
    let mut request = [0u8; 4096];
    let mut n = 0;
    // Four reads bound the time that a slow client takes.
    for _ in 0..4 {
        let got = stream.read(&mut request[n..])?;
        n += got;
        if got == 0 || n == request.len() || request[..n].windows(4).any(|w| w == b"\r\n\r\n") {
            break;
        }
    }
    let line = request[..n].split(|b| *b == b'\r').next().unwrap_or(&[]);
    let known =
        [&b"GET / "[..], b"GET /metrics ", b"GET /metrics?"].iter().any(|known| line.starts_with(known));
    let (status, body) = if known {
        ("200 OK", page.lock().map(|p| p.clone()).unwrap_or_default())
    } else {
        ("404 Not Found", "the page is at /metrics\n".to_owned())
    };
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}",
        body.len()
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::telemetry::profile::Distribution;

    fn get(address: SocketAddr, request: &[u8]) -> String {
        let mut stream = TcpStream::connect(address).unwrap();
        stream.write_all(request).unwrap();
        let mut text = String::new();
        let _ = stream.read_to_string(&mut text);
        text
    }

    #[test]
    fn the_page_is_valid_exposition_text() {
        let d = Distribution { count: 4, mean: 2.0, p50: 1.5, p99: 3.0, ..Default::default() };
        let early = Distribution { count: 4, mean: -2.0, p50: -0.25, negative: 4, ..Default::default() };
        let profile = ProfileReport {
            missed: [("li\"nk\n".to_owned(), 7)].into(),
            ordered_dark: [("black".to_owned(), 9)].into(),
            intervals_ms: [("render".to_owned(), d), ("lateness".to_owned(), early)].into(),
            ..Default::default()
        };
        let counts = RunCounts { frames_lit: 12, slots: 40, slots_missed: 7, ..Default::default() };
        let text = page(&counts, Some(&profile));
        let mut typed = Vec::new();
        for line in text.lines() {
            if let Some(rest) = line.strip_prefix("# TYPE ") {
                typed.push(rest.split(' ').next().unwrap().to_owned());
            } else if !line.starts_with('#') {
                let (name, value) = line.rsplit_once(' ').unwrap();
                assert!(value.parse::<f64>().is_ok(), "{line}");
                let family = name.split('{').next().unwrap();
                assert!(typed.iter().any(|t| family.starts_with(t.as_str())), "{line} has no type");
            }
        }
        assert!(text.contains("dpm_frames_lit_total 12\n"));
        assert!(text.contains("dpm_slots_total 40\n") && text.contains("dpm_slots_missed_total 7\n"));
        assert!(text.contains(r#"dpm_slots_missed_by_cause_total{cause="li\"nk\n"} 7"#));
        assert!(text.contains(r#"dpm_slots_ordered_dark_total{reason="black"} 9"#));
        assert!(text.contains(r#"dpm_interval_negative_total{interval="lateness"} 4"#));
        assert!(text.contains(r#"dpm_interval_seconds{interval="lateness",quantile="0.5"} -0.00025"#));
        assert!(text.contains(r#"dpm_interval_seconds{interval="render",quantile="0.5"} 0.0015"#));
        assert!(text.contains(r#"dpm_interval_seconds_sum{interval="render"} 0.008"#));
    }

    #[test]
    fn it_answers_scrapes_and_survives_bad_clients() {
        let server = PageServer::start("127.0.0.1:0").unwrap();
        server.show("dpm_up 1\n".into());
        assert!(get(server.address(), b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
            .ends_with("\r\n\r\ndpm_up 1\n"));
        assert!(get(server.address(), b"GET /etc/passwd HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 404"));
        drop(TcpStream::connect(server.address()).unwrap());
        get(server.address(), &[0xff; 9000]);
        assert!(get(server.address(), b"GET / HTTP/1.0\r\n\r\n").contains("dpm_up 1"));
    }
}
