//! Found in use, R5: another program on the rig's port while the rig is down, with the rig's page open in a browser. It gains
//! neither the key nor an order, before and after a reload, and the page says that it is not the rig.

use crate::browser;
use crate::browser::{Browser, PATIENCE};
use crate::cli_common::{self, code, dpm, err, out, own_folder, start_with};
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

fn rig(address: &str) -> cli_common::ChildProgram {
    let page = format!("--page={address}");
    let args = ["demo", "--raster", "64x48", "--pace", "real", "--set", "run.frames=0", "--set"];
    let mut rig = start_with(&[args.as_slice(), &["output.images=false", &page]].concat(), &[]);
    rig.wait_for_line(PATIENCE, |line| line.contains("page: http"));
    rig
}

/// What an impostor would like a browser to run: it looks for whatever the rig's page has left there, and for a signature.
const THIEF: &str = "<!doctype html><title>rig</title><script>
(async () => {
  const found = { storage: JSON.stringify([{ ...localStorage }, { ...sessionStorage }, document.cookie, location.href]), keys: [] };
  for (const { name } of await indexedDB.databases()) {
    const db = await new Promise(done => { const open = indexedDB.open(name); open.onsuccess = () => done(open.result); });
    for (const store of db.objectStoreNames) {
      const all = await new Promise(done => { const get = db.transaction(store).objectStore(store).getAll(); get.onsuccess = () => done(get.result); });
      for (const key of all) {
        const did = async what => { try { await what(); return true; } catch { return false; } };
        found.keys.push({ text: JSON.stringify(key), isKey: key instanceof CryptoKey,
          exported: await did(() => crypto.subtle.exportKey('raw', key)), signed: await did(() => crypto.subtle.sign('HMAC', key, new Uint8Array(1))) });
      }
    }
    db.close();
  }
  window.found = found;
})();
</script>";

/// Answers everything as the rig would, as far as anybody can, and keeps what it is asked.
struct Impostor {
    stop: Arc<AtomicBool>,
    heard: Arc<Mutex<String>>,
    /// A browser opens connections before it needs them.
    streams: Arc<Mutex<Vec<TcpStream>>>,
    address: SocketAddr,
    thread: Option<JoinHandle<()>>,
}

impl Impostor {
    fn at(address: &str) -> Self {
        let address: SocketAddr = address.parse().unwrap();
        let begin = Instant::now();
        let listener = loop {
            match TcpListener::bind(address) {
                Ok(listener) => break listener,
                Err(e) => assert!(begin.elapsed() < PATIENCE, "{address}: {e}"),
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        let (stop, heard) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(String::new())));
        let streams = Arc::new(Mutex::new(Vec::new()));
        let thread = std::thread::spawn({
            let (stop, heard, streams) = (stop.clone(), heard.clone(), streams.clone());
            move || {
                for stream in listener.incoming().map_while(Result::ok) {
                    if stop.load(Ordering::SeqCst) {
                        return;
                    }
                    let heard = heard.clone();
                    streams.lock().unwrap().push(stream.try_clone().unwrap());
                    std::thread::spawn(move || answer(stream, &heard));
                }
            }
        });
        Self { stop, heard, streams, address, thread: Some(thread) }
    }

    fn heard(&self) -> String {
        self.heard.lock().unwrap().clone()
    }
}

impl Drop for Impostor {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        let _ = TcpStream::connect(self.address);
        let _ = self.thread.take().map(JoinHandle::join);
        for stream in self.streams.lock().unwrap().iter() {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

fn answer(mut stream: TcpStream, heard: &Mutex<String>) {
    let mut bytes = [0; 8192];
    let n = stream.read(&mut bytes).unwrap_or(0);
    let text = String::from_utf8_lossy(&bytes[..n]).into_owned();
    heard.lock().unwrap().push_str(&text);
    let proof = format!("X-Dpm-Proof: {}\r\n", "0".repeat(64));
    let whole = |kind: &str, body: &str| {
        format!(
            "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\n{proof}Content-Length: {}\r\nConnection: close\r\n\r\n{body}",
            body.len()
        )
    };
    let answer = match text.split(' ').nth(1).unwrap_or("") {
        path if path.starts_with("/api/events") => {
            let state = r#"{"pid":1,"up_s":1,"light":{"word":"LIT","state":"lit","told":"","is_lit":true},"standing":null,"interlock":null,"tracker":null,"is_stopping":false,"counts":{"frames_lit":1,"slots":1,"slots_missed":0},"viewers":1}"#;
            let id = "0".repeat(64);
            format!("HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\nevent: state\ndata: {state}\nid: {id}\n\n")
        }
        "/api/challenge" => whole("text/plain", &"0".repeat(80)),
        path if path.starts_with("/api/orders") => whole(
            "application/json",
            r#"{"order":"black","done":true,"text":"ok: projector dark","obeyed_ms":1}"#,
        ),
        "/" => whole("text/html", THIEF),
        _ => whole("text/plain", "ok"),
    };
    let _ = stream.write_all(answer.as_bytes());
    if answer.contains("event-stream") {
        // It stays open, as the rig's events do.
        let _ = stream.read(&mut bytes);
    }
    let _ = stream.shutdown(Shutdown::Both);
}

#[test]
fn an_impostor_on_the_port_gains_neither_key_nor_order_and_is_called_what_it_is() {
    let program = &browser::installed();
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let first = rig(&address);
    let link = dpm(&["page", &address], &[]);
    assert_eq!(code(&link), 0, "{}", err(&link));
    let link = out(&link).trim().to_owned();
    let key = link.split_once("#key=").expect("a link with the key").1.to_owned();
    let mut browser = Browser::open(program, &own_folder("browser"), &link);
    let state = "document.getElementById('state').textContent";
    browser.wait("light", &format!("{state} === 'LIT'"));
    assert_eq!(browser.value("location.hash"), "", "the key stays in the address");
    browser.wait("buttons", "!document.getElementById('black').disabled");
    assert_eq!(browser.value("document.body.classList.contains('unproven')"), false);

    // The rig goes, and somebody else takes its port.
    drop(first);
    browser.wait("silence", &format!("{state} === 'NO CONTACT'"));
    let impostor = Impostor::at(&address);
    browser.wait("its name", &format!("{state} === 'NOT THE RIG'"));
    browser.value("void give('black')");
    let said = "document.getElementById('answer').textContent";
    browser.wait("answer", &format!("{said}.startsWith('BLACK: NOT done: what answered is not the rig')"));
    assert_eq!(browser.value("document.getElementById('answer').className"), "bad");
    assert_eq!(browser.value(state), "NOT THE RIG");
    let output = dpm(&["page", &address], &[]);
    assert!(code(&output) == 1 && err(&output).contains("is not the rig"), "{}", err(&output));
    assert!(!out(&output).contains(&key));

    // A reload runs what the impostor serves.
    browser.call("Page.reload", serde_json::json!({}));
    browser.wait("the thief", "Boolean(window.found)");
    let found = browser.value("window.found");
    assert!(!found.to_string().contains(&key), "{found}");
    let keys = found["keys"].as_array().unwrap();
    assert!(!keys.is_empty() && keys.iter().all(|k| k["isKey"] == true), "{found}");
    assert!(
        keys.iter().all(|k| k["exported"] == false && k["signed"] == false && k["text"] == "{}"),
        "{found}"
    );
    let heard = impostor.heard();
    let lower = heard.to_ascii_lowercase();
    assert!(heard.contains("GET /api/challenge") && !heard.contains(&key), "{heard}");
    assert!(!lower.contains("x-dpm-order"), "nothing is signed for an impostor: {heard}");
    drop(impostor);

    // The rig comes back. The page that the thief runs in gives no order, and the link works again.
    let second = rig(&address);
    let status = "(async () => (await fetch('/api/orders/black', { method: 'POST', headers: { 'X-Dpm-Order': 'x y' } })).status)()";
    assert_eq!(browser.value(status), 403);
    browser.call("Page.reload", serde_json::json!({}));
    browser.wait("light", &format!("document.getElementById('state') && {state} === 'LIT'"));
    // A reload keeps what proves the rig, and not what orders.
    browser.wait(
        "view only",
        "!document.getElementById('keyless').hidden && document.getElementById('unproven').hidden",
    );
    assert_eq!(browser.value("document.body.classList.contains('unproven')"), false);
    assert_eq!(browser.value("document.getElementById('arm').disabled"), true);
    browser.value(&format!("location.hash = '#key={key}'"));
    browser.wait("buttons", "!document.getElementById('black').disabled");
    browser.click("black");
    browser.wait("answer", &format!("{said}.startsWith('BLACK: ok: projector black')"));
    drop(second);
}
