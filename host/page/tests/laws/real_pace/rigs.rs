//! The overview of several rigs: it shows those that answer, says of the others why not, and none delays another.

use crate::common::{ask, HttpAnswer, RunWithPage, PATIENCE};
use dpm_page::rigs::Rigs;
use dpm_page::Page;
use serde_json::Value;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A state as a rig tells it, and a field that no version has.
const STATE: &str = r#"{"now":{"pid":7,"up_s":UP,"light":{"word":"LIT","state":"lit","told":"","is_lit":true},"standing":null,
    "interlock":["pin",true],"tracker":null,"is_stopping":false,"counts":{"frames_planned":9,"frames_lit":FRAMES,
    "frames_dark":0,"slots":FRAMES,"slots_missed":0,"more":1},"viewers":1,"secret":"unknown field"},"figures":{"bodies":[
    {"name":"bunny","seen":true,"dark":null,"told":null,"at_m":[0,0,1]},
    {"name":"teapot","seen":true,"dark":"silent","told":"LONG","at_m":[0,0,1]}],
    "link":{"celsius":41.5},"setup":{"rig":"/etc/dpm/stage.toml","version":"0.1.0","commit":"abc"}}}"#;

/// A server that is no rig: what it does with every connection, and what it was asked.
struct Fake {
    address: SocketAddr,
    asked: Arc<AtomicUsize>,
    heads: Arc<Mutex<Vec<String>>>,
}

impl Fake {
    fn serve(answer: impl Fn(TcpStream) + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let this =
            Self { address: listener.local_addr().unwrap(), asked: Arc::default(), heads: Arc::default() };
        let (asked, heads, answer) = (this.asked.clone(), this.heads.clone(), Arc::new(answer));
        // It ends with the test's process.
        std::thread::spawn(move || {
            for mut stream in listener.incoming().map_while(Result::ok) {
                asked.fetch_add(1, Ordering::SeqCst);
                let (heads, answer) = (heads.clone(), answer.clone());
                std::thread::spawn(move || {
                    let mut head = Vec::new();
                    let mut byte = [0];
                    while !head.ends_with(b"\r\n\r\n") && stream.read(&mut byte).is_ok_and(|n| n == 1) {
                        head.push(byte[0]);
                    }
                    heads.lock().unwrap().push(String::from_utf8_lossy(&head).into_owned());
                    answer(stream);
                });
            }
        });
        this
    }

    /// A rig that works, at 50 frames a second.
    fn good() -> Self {
        let begin = Instant::now();
        Self::serve(move |mut stream| {
            let up = begin.elapsed().as_secs_f64() + 10.0;
            let text =
                STATE.replace("UP", &up.to_string()).replace("FRAMES", &((up * 50.0) as u64).to_string());
            let _ = stream.write_all(http("200 OK", &text.replace("LONG", &"long ".repeat(1000))).as_bytes());
        })
    }

    fn saying(text: impl Into<String>) -> Self {
        let text = text.into();
        Self::serve(move |mut stream| {
            let _ = stream.write_all(text.as_bytes());
        })
    }

    fn asked(&self) -> usize {
        self.asked.load(Ordering::SeqCst)
    }
}

fn http(status: &str, body: &str) -> String {
    format!("HTTP/1.1 {status}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}", body.len())
}

fn overview(rigs: &[String]) -> Page {
    let rigs = Rigs::new(rigs.iter().map(|rig| rig.parse().unwrap()).collect()).unwrap();
    Page::serve_rigs("127.0.0.1:0".parse().unwrap(), rigs).unwrap()
}

fn get(page: &Page, path: &str) -> HttpAnswer {
    ask(page.address(), "GET", path, &[("Host", &page.address().to_string())])
}

/// What the overview says of the rig called `name`.
fn told(page: &Page, name: &str) -> Value {
    let all: Value = serde_json::from_str(&get(page, "/api/rigs").body).unwrap();
    let mut rigs = all["rigs"].as_array().unwrap().iter();
    rigs.find(|rig| rig["name"] == name).unwrap_or_else(|| panic!("{name} in {all}")).clone()
}

/// Looks until what is said of the rig `is` so.
fn wait(page: &Page, name: &str, limit: Duration, is: impl Fn(&Value) -> bool) -> Value {
    let begin = Instant::now();
    loop {
        let rig = told(page, name);
        if is(&rig) {
            return rig;
        }
        assert!(begin.elapsed() < limit, "after {limit:?}: {rig}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_rig_that_answers_is_shown_and_each_that_does_not_says_why() {
    let nobody = TcpListener::bind("127.0.0.1:0").unwrap();
    let closed = nobody.local_addr().unwrap();
    let good = Fake::good();
    let silent = Fake::serve(|stream| {
        std::thread::sleep(PATIENCE);
        drop(stream);
    });
    let endless = Fake::serve(|mut stream| {
        let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n");
        for _ in 0..160 {
            if stream.write_all(&[b' '; 65_536]).is_err() {
                return;
            }
        }
    });
    let slow = Fake::serve(|mut stream| {
        let _ = stream.write_all(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n{\"now\":");
        while stream.write_all(b" ").is_ok() {
            std::thread::sleep(Duration::from_millis(100));
        }
    });
    let deep = "[".repeat(100_000);
    let bad = [
        ("silent", silent.address, "no answer within 2 s"),
        ("slow", slow.address, "no answer within 2 s"),
        ("closed", closed, "nobody listens there; start the rig with --page"),
        ("noise", Fake::saying("\0\u{1}\u{2}nonsense\r\n\r\n").address, "does not speak HTTP"),
        ("nothing", Fake::saying("").address, "behind a tunnel this means that the rig does not run"),
        (
            "half",
            Fake::saying("HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\n{").address,
            "without a whole answer",
        ),
        ("endless", endless.address, "longer than 256 KiB"),
        ("other", Fake::saying(http("421 Misdirected Request", "no")).address, "so it is no rig's page"),
        ("guide", Fake::saying(http("404 Not Found", "no")).address, "no run is shown there"),
        ("ill", Fake::saying(http("500 Internal Server Error", "no")).address, "status 500"),
        ("words", Fake::saying(http("200 OK", "up")).address, "not the state of a rig"),
        ("object", Fake::saying(http("200 OK", "{\"now\":{\"pid\":-1}}")).address, "not the state of a rig"),
        ("deep", Fake::saying(http("200 OK", &deep)).address, "not the state of a rig"),
        (
            "head",
            Fake::saying(format!("HTTP/1.1 200 OK\r\nX: {deep}\r\n\r\n")).address,
            "does not speak HTTP",
        ),
    ];
    let mut names: Vec<String> = bad.iter().map(|(name, address, _)| format!("{name}={address}")).collect();
    names.push(format!("good={}", good.address));
    // Until here, so that none of the others was given its port.
    drop(nobody);
    let page = overview(&names);
    let rig = wait(&page, "good", Duration::from_secs(2), |rig| rig["contact"] == "yes");
    assert_eq!(rig["address"], good.address.to_string());
    assert_eq!(rig["port"], good.address.port());
    assert!(
        rig["why"].is_null()
            && rig["told"]["light"]["word"] == "LIT"
            && rig["told"]["light"]["is_lit"] == true,
        "{rig}"
    );
    assert_eq!(rig["told"]["celsius"], 41.5);
    assert_eq!(rig["told"]["bodies"][0]["dark"], Value::Null);
    assert_eq!(rig["told"]["bodies"][1]["dark"], "silent");
    assert!(rig["told"]["bodies"][1]["told"].as_str().unwrap().chars().count() < 300, "a text is cut");
    assert!(!rig.to_string().contains("unknown field"), "known fields only: {rig}");
    for (name, _, why) in bad {
        let rig = wait(&page, name, PATIENCE, |rig| rig["contact"] == "no");
        assert!(rig["why"].as_str().unwrap().contains(why), "{name}: {rig}");
        assert!(rig["heard_s_ago"].is_null() && rig["told"].is_null(), "{name}: {rig}");
    }
    // Meanwhile the good one went on.
    let rig = wait(&page, "good", PATIENCE, |rig| rig["told"]["lit_per_s"].is_number());
    let rate = rig["told"]["lit_per_s"].as_f64().unwrap();
    assert!(rig["contact"] == "yes" && (40.0..60.0).contains(&rate), "{rig}");
    assert!(rig["told"]["missed"] == 0.0 && rig["heard_s_ago"].as_f64().unwrap() < 2.5, "{rig}");
}

#[test]
fn nobody_who_looks_means_no_question() {
    let good = Fake::good();
    let page = overview(&[format!("good={}", good.address)]);
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(good.asked(), 0, "nobody has looked yet");
    get(&page, "/");
    wait(&page, "good", PATIENCE, |rig| rig["contact"] == "yes");
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(3) {
        told(&page, "good");
        std::thread::sleep(Duration::from_millis(50));
    }
    let asked = good.asked();
    assert!((3..=5).contains(&asked), "once a second, however often somebody looks: {asked}");
    std::thread::sleep(Duration::from_millis(6500));
    let after = good.asked();
    assert!(after <= asked + 6, "{after}");
    std::thread::sleep(Duration::from_secs(3));
    assert_eq!(good.asked(), after, "it is asked although nobody looks");
    // Whoever comes back is told that the rig is asked, and not that it is gone.
    assert_eq!(told(&page, "good")["contact"], "asked");
    wait(&page, "good", Duration::from_secs(2), |rig| rig["contact"] == "yes");
}

#[test]
fn a_rig_is_asked_by_the_port_of_its_address() {
    let good = Fake::good();
    let page = overview(&[format!("good={}", good.address)]);
    wait(&page, "good", PATIENCE, |rig| rig["contact"] == "yes");
    let head = good.heads.lock().unwrap()[0].to_ascii_lowercase();
    assert!(head.starts_with("get /api/state http/1.1\r\n"), "{head}");
    assert!(head.contains(&format!("\r\nhost: localhost:{}\r\n", good.address.port())), "{head}");
}

/// What `ssh -L` does: another port of this machine leads to the rig's. The overview shows the rig, and its page takes orders of its own
/// and of nobody else.
#[test]
fn a_rig_is_shown_and_commanded_through_a_tunnel() {
    let mut rig = RunWithPage::start("tunnel");
    let to = rig.address;
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let tunnel = listener.local_addr().unwrap();
    // It ends with the test's process.
    std::thread::spawn(move || {
        for near in listener.incoming().map_while(Result::ok) {
            let Ok(far) = TcpStream::connect(to) else { continue };
            for (mut from, mut into) in [(near.try_clone().unwrap(), far.try_clone().unwrap()), (far, near)] {
                std::thread::spawn(move || {
                    let _ = std::io::copy(&mut from, &mut into);
                    let _ = into.shutdown(std::net::Shutdown::Write);
                });
            }
        }
    });
    let page = overview(&[format!("rig={tunnel}")]);
    let now = wait(&page, "rig", PATIENCE, |rig| rig["contact"] == "yes");
    assert_eq!(now["port"], tunnel.port());
    let order = |origin: &str| {
        let host = tunnel.to_string();
        let signed = rig.signed("POST", "/api/orders/black");
        let headers = [("Host", host.as_str()), ("Origin", origin), ("X-Dpm-Order", signed.as_str())];
        ask(tunnel, "POST", "/api/orders/black", &headers).status
    };
    assert_eq!(order(&format!("http://{to}")), 200, "the rig's own name stays one of its own");
    assert_eq!(order("http://127.0.0.1:1"), 403, "a server at another port of this machine");
    assert_eq!(order(&format!("http://{tunnel}")), 200);
    wait(&page, "rig", PATIENCE, |rig| rig["told"]["light"]["word"] == "DARK BY ORDER");
    rig.end_run();
}

#[test]
fn a_real_rig_is_understood_and_its_silence_is_told() {
    let mut rig = RunWithPage::start("overview");
    let page = overview(&[format!("rig={}", rig.address)]);
    let now = wait(&page, "rig", PATIENCE, |rig| rig["told"]["lit_per_s"].as_f64().is_some_and(|n| n > 1.0));
    assert!(now["told"]["light"]["word"] == "LIT" && now["told"]["light"]["is_lit"] == true, "{now}");
    assert!(
        !now["told"]["bodies"].as_array().unwrap().is_empty() && now["told"]["celsius"].is_null(),
        "{now}"
    );
    assert_eq!(now["told"]["version"], env!("CARGO_PKG_VERSION"));
    rig.order("black");
    let now = wait(&page, "rig", PATIENCE, |rig| rig["told"]["light"]["word"] == "DARK BY ORDER");
    assert!(now["told"]["light"]["is_lit"] == false, "{now}");
    rig.end_run();
    drop(rig);
    let now = wait(&page, "rig", PATIENCE, |rig| rig["contact"] == "no");
    assert!(
        now["told"]["light"]["word"] == "DARK BY ORDER" && now["heard_s_ago"].as_f64().unwrap() >= 3.0,
        "{now}"
    );
    assert!(now["why"].as_str().unwrap().contains("nobody listens"), "{now}");
}

#[test]
fn the_overview_refuses_other_names_other_sites_and_orders() {
    let good = Fake::good();
    let page = overview(&[format!("good={}", good.address)]);
    let body = get(&page, "/").body;
    assert!(body.ends_with("</html>\n") && !body.contains("{{") && body.contains("--ground: #"));
    assert!(!body.contains("dpm-page"), "it needs no key");
    assert!(get(&page, "/").head.contains("script-src 'nonce-"));
    let own = page.address().to_string();
    let host = ("Host", own.as_str());
    for (headers, status) in [
        (vec![("Host", "evil.example")], 421),
        (vec![], 421),
        (vec![host, ("Sec-Fetch-Site", "cross-site")], 403),
        (vec![host, ("Origin", "https://evil.example")], 403),
        (vec![host], 200),
    ] {
        let answer = ask(page.address(), "GET", "/api/rigs", &headers);
        assert_eq!(answer.status, status, "{headers:?}: {}", answer.body);
        assert!(!answer.body.contains("page.hosts"), "an overview has no rig file: {}", answer.body);
    }
    for path in ["/api/orders/black", "/api/parameters/undo", "/api/calibration/stop", "/api/rigs"] {
        assert_eq!(ask(page.address(), "POST", path, &[host]).status, 405, "{path}");
    }
    for path in ["/api/state", "/api/events", "/metrics", "/calibration", "/api/key", "/api/flights/0"] {
        assert_eq!(get(&page, path).status, 404, "{path}");
    }
    let far = Rigs::new(vec!["127.0.0.1:1".parse().unwrap()]).unwrap();
    let refused = Page::serve_rigs("0.0.0.0:0".parse().unwrap(), far).unwrap_err().to_string();
    assert!(refused.contains("listen on 127.0.0.1"), "{refused}");
}
