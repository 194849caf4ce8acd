//! A rig with mocks at real pace, its page, and a client of a few lines.
#![allow(dead_code)] // Every test file uses a part of it.

use dpm_device::planes::Raster;
use dpm_page::calibration::{Act, Guide, StepSession};
use dpm_page::proof::{sign_request, Key};
use dpm_page::token::Token;
use dpm_page::{Page, Settings};
use dpm_rig::calibration_steps::{About, Steps};
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::control::orders::Orders;
use dpm_rig::pipeline::{run_prepared, RunOptions, RunOutcome};
use dpm_rig::rig::Rig;
use dpm_rig::standing::{Identity, OrderFile};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_rig::telemetry::notes::Notes;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

/// How long anything may take on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

/// The steps of a rig file that need not exist.
#[derive(Debug)]
pub(crate) struct NoSteps {
    pub(crate) rig: PathBuf,
    pub(crate) config: RigConfig,
}

impl Guide for NoSteps {
    fn steps(&self) -> Steps {
        let now = SystemTime::now();
        Steps::of(&About { rig: &self.rig, config: &self.config, file: None, now, running_since: None })
    }

    fn session(&self) -> Option<StepSession> {
        None
    }

    fn act(&self, act: Act) -> Result<(), String> {
        Err(format!("nobody does {act:?} here"))
    }

    fn ports(&self) -> Vec<String> {
        vec!["/dev/ttyACM9".into()]
    }
}

pub(crate) struct RunWithPage {
    pub(crate) monitor: Arc<RunMonitor>,
    pub(crate) notes: Arc<Notes>,
    pub(crate) token: Token,
    pub(crate) address: SocketAddr,
    page: Option<Page>,
    orders: Option<Arc<Orders>>,
    run: Option<JoinHandle<RunOutcome>>,
    dir: PathBuf,
}

impl RunWithPage {
    /// A rig of prepared frames with the mock tracker and the mock projector, which runs until it is stopped.
    pub(crate) fn start(name: &str) -> Self {
        Self::with(name, &["real_time.pace=\"real\"", "projector.frame_rate=\"100/1\""])
    }

    pub(crate) fn with(name: &str, flags: &[&str]) -> Self {
        let dir = std::env::temp_dir().join(format!("dpm-page-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let config =
            RigConfig::demo(&Overrides { flags, ..Overrides::default() }).unwrap_or_else(|e| panic!("{e}"));
        let monitor = Arc::new(RunMonitor::default());
        let (file, error, _) = OrderFile::open(Some(dir.clone()), Identity::of(&config.projector.backend));
        assert!(error.is_none(), "{error:?}");
        let orders = Arc::new(Orders::start(monitor.clone(), file, true, None).unwrap());
        let (token, _) = Token::kept_in(&dir, 0).unwrap();
        let settings = Settings {
            address: "127.0.0.1:0".parse().unwrap(),
            hosts: vec!["rig.example.org".into()],
            token: Some(token.clone()),
            guide: Arc::new(NoSteps { rig: dir.join("rig.toml"), config: config.clone() }),
        };
        let notes = Arc::new(Notes::default());
        let page = Page::serve(settings, monitor.clone(), orders.clone(), notes.clone()).unwrap();
        let run = std::thread::spawn({
            let monitor = monitor.clone();
            move || {
                let rig = Arc::new(Rig::build(&config, Raster::new(64, 48)).unwrap());
                run_prepared(rig, RunOptions::default(), &monitor).unwrap_or_else(|e| panic!("{e}"))
            }
        });
        let address = page.address();
        let this = Self {
            monitor,
            notes,
            token,
            address,
            page: Some(page),
            orders: Some(orders),
            run: Some(run),
            dir,
        };
        this.wait("light", || this.monitor.counts().frames_lit > 3);
        this
    }

    pub(crate) fn wait(&self, what: &str, is: impl Fn() -> bool) {
        let begin = Instant::now();
        while !is() {
            assert!(begin.elapsed() < PATIENCE, "no {what}: {:?}", self.monitor.counts());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// The answer to a request with the headers that a browser would send, and with `more`.
    pub(crate) fn ask(&self, method: &str, path: &str, more: &[(&str, &str)]) -> HttpAnswer {
        let host = self.address.to_string();
        let mut headers = vec![("Host", host.as_str())];
        headers.extend(more);
        ask(self.address, method, path, &headers)
    }

    /// The value of the header by which a request is signed, once.
    pub(crate) fn signed(&self, method: &str, path: &str) -> String {
        signed_by(&self.token, method, path, &self.ask("GET", "/api/challenge", &[]).body)
    }

    /// Asks with a signature.
    pub(crate) fn ask_signed(&self, method: &str, path: &str) -> HttpAnswer {
        self.ask(method, path, &[("X-Dpm-Order", &self.signed(method, path))])
    }

    /// Gives an order with the right signature.
    pub(crate) fn order(&self, word: &str) -> serde_json::Value {
        let answer = self.ask_signed("POST", &format!("/api/orders/{word}"));
        assert_eq!(answer.status, 200, "{}", answer.body);
        serde_json::from_str(&answer.body).unwrap()
    }

    /// Ends the run, not the page.
    pub(crate) fn end_run(&mut self) -> RunOutcome {
        self.monitor.request_stop();
        self.run.take().expect("ended once").join().unwrap()
    }
}

impl Drop for RunWithPage {
    fn drop(&mut self) {
        self.monitor.request_stop();
        if let Some(run) = self.run.take() {
            let _ = run.join();
        }
        drop(self.page.take());
        if let Some(orders) = self.orders.take().and_then(Arc::into_inner) {
            orders.end(true);
        }
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}

/// The value of the header by which a request is signed over `challenge`.
pub(crate) fn signed_by(token: &Token, method: &str, path: &str, challenge: &str) -> String {
    format!("{challenge} {}", sign_request(&Key::of_orders(token), method, path, challenge))
}

#[derive(Debug)]
pub(crate) struct HttpAnswer {
    pub(crate) status: u16,
    pub(crate) head: String,
    pub(crate) body: String,
}

pub(crate) fn ask(address: SocketAddr, method: &str, path: &str, headers: &[(&str, &str)]) -> HttpAnswer {
    let mut text = format!("{method} {path} HTTP/1.1\r\nConnection: close\r\n");
    for (name, value) in headers {
        text += &format!("{name}: {value}\r\n");
    }
    send(address, (text + "\r\n").as_bytes()).unwrap_or_else(|e| panic!("{method} {path}: {e}"))
}

/// Sends bytes and reads the answer to its end.
pub(crate) fn send(address: SocketAddr, bytes: &[u8]) -> std::io::Result<HttpAnswer> {
    let mut stream = TcpStream::connect_timeout(&address, PATIENCE)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.write_all(bytes)?;
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer)?;
    let text = String::from_utf8_lossy(&answer);
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
    let status = head.split(' ').nth(1).and_then(|s| s.parse().ok()).unwrap_or(0);
    Ok(HttpAnswer { status, head: head.to_owned(), body: body.to_owned() })
}

/// One who follows the events of a rig.
pub(crate) struct Viewer<'a> {
    pub(crate) rig: &'a RunWithPage,
    lines: BufReader<TcpStream>,
}

impl<'a> Viewer<'a> {
    pub(crate) fn new(rig: &'a RunWithPage) -> Self {
        let mut stream = TcpStream::connect(rig.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let request = format!("GET /api/events HTTP/1.1\r\nHost: {}\r\n\r\n", rig.address);
        stream.write_all(request.as_bytes()).unwrap();
        Self { rig, lines: BufReader::new(stream) }
    }

    /// The data of the next event of this name for which `is` holds.
    pub(crate) fn next(&mut self, name: &str, is: impl Fn(&serde_json::Value) -> bool) -> serde_json::Value {
        let begin = Instant::now();
        let mut event = String::new();
        loop {
            assert!(begin.elapsed() < PATIENCE, "no such {name}: {:?}", self.rig.monitor.counts());
            let mut line = String::new();
            self.lines.read_line(&mut line).unwrap();
            if let Some(name) = line.trim_end().strip_prefix("event: ") {
                event = name.to_owned();
            } else if let Some(data) = line.strip_prefix("data: ").filter(|_| event == name) {
                let data = serde_json::from_str(data.trim_end()).unwrap();
                if is(&data) {
                    return data;
                }
            }
        }
    }
}
