//! Drives a headless Chromium over its debugging pipe: JSON messages that end with a zero byte.

use base64::prelude::{Engine, BASE64_STANDARD};
use serde_json::{json, Value};
use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{channel, Receiver};
use std::time::{Duration, Instant};

/// Names of the program.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
/// How long anything in the browser may take on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// The path of a Chromium of this machine.
pub(crate) fn installed() -> PathBuf {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path)
        .flat_map(|dir| NAMES.map(|name| dir.join(name)))
        .find(|file| file.is_file())
        .expect("this test needs a Chromium (Debian: apt-get install chromium)")
}

/// A browser with one open page.
pub(crate) struct Browser {
    child: Child,
    to: File,
    from: Receiver<Value>,
    number: u64,
    session: String,
    /// What the page complained about: exceptions, errors on the console, refused resources.
    pub(crate) complaints: Vec<String>,
    folder: PathBuf,
}

impl Browser {
    /// Starts `program` with an empty profile in `folder`, and opens `url`.
    pub(crate) fn open(program: &Path, folder: &Path, url: &str) -> Self {
        let _ = std::fs::remove_dir_all(folder);
        std::fs::create_dir_all(folder.join("profile")).unwrap();
        let pipes = ["to", "from"].map(|name| folder.join(name));
        assert!(Command::new("mkfifo").args(&pipes).status().unwrap().success());
        // The browser reads descriptor 3 and writes descriptor 4. Its sandbox refuses to run as root.
        let line = "exec 3<\"$1\" 4>\"$2\"; shift 2; exec \"$0\" \"$@\"";
        let mut command = Command::new("sh");
        command.args(["-c", line]).arg(program).args(&pipes);
        command.args(["--headless=new", "--remote-debugging-pipe", "--no-sandbox", "--disable-gpu"]);
        command.args(["--no-first-run", "--disable-dev-shm-usage", "--hide-scrollbars", "--mute-audio"]);
        command.arg(format!("--user-data-dir={}", folder.join("profile").display()));
        let log = File::create(folder.join("log")).unwrap();
        let child = command
            .env_remove("DBUS_SESSION_BUS_ADDRESS")
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .unwrap();
        // Each call waits for the other end.
        let to = OpenOptions::new().write(true).open(&pipes[0]).unwrap();
        let from = File::open(&pipes[1]).unwrap();
        let (told, heard) = channel();
        std::thread::spawn(move || {
            for message in BufReader::new(from).split(0).map_while(Result::ok) {
                let parsed = serde_json::from_slice(&message).unwrap_or(Value::Null);
                if told.send(parsed).is_err() {
                    return;
                }
            }
        });
        let mut this = Self {
            child,
            to,
            from: heard,
            number: 0,
            session: String::new(),
            complaints: Vec::new(),
            folder: folder.into(),
        };
        let target = this.call("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        this.session = this.call("Target.attachToTarget", attach)["sessionId"].as_str().unwrap().to_owned();
        for domain in ["Page.enable", "Runtime.enable", "Log.enable"] {
            this.call(domain, json!({}));
        }
        this.call("Page.navigate", json!({ "url": url }));
        this.wait("page", "location.protocol !== 'about:' && document.readyState === 'complete'");
        this
    }

    /// Calls a method and returns its result.
    pub(crate) fn call(&mut self, method: &str, parameters: Value) -> Value {
        self.try_call(method, parameters).unwrap_or_else(|error| panic!("{method}: {error}"))
    }

    /// Calls a method and returns its result, or the error that the browser answers.
    fn try_call(&mut self, method: &str, parameters: Value) -> Result<Value, Value> {
        self.number += 1;
        let mut message = json!({ "id": self.number, "method": method, "params": parameters });
        if !self.session.is_empty() {
            message["sessionId"] = json!(self.session);
        }
        self.to.write_all((message.to_string() + "\0").as_bytes()).unwrap();
        let begin = Instant::now();
        loop {
            let left = PATIENCE.saturating_sub(begin.elapsed());
            let Ok(mut told) = self.from.recv_timeout(left) else {
                let log = std::fs::read_to_string(self.folder.join("log")).unwrap_or_default();
                panic!("no answer to {method}: {log}");
            };
            if told["id"] == self.number {
                let (error, result) = (told["error"].take(), told["result"].take());
                return if error.is_null() { Ok(result) } else { Err(error) };
            }
            self.listen(&told);
        }
    }

    fn listen(&mut self, event: &Value) {
        let parameters = &event["params"];
        match event["method"].as_str() {
            Some("Runtime.exceptionThrown") => {
                self.complaints.push(parameters["exceptionDetails"]["exception"]["description"].to_string());
            }
            Some("Runtime.consoleAPICalled") if parameters["type"] == "error" => {
                self.complaints.push(parameters["args"].to_string());
            }
            Some("Log.entryAdded") if parameters["entry"]["level"] == "error" => {
                self.complaints.push(parameters["entry"]["text"].to_string());
            }
            _ => {}
        }
    }

    /// The value of a JavaScript expression; of what it promises, if it is a promise.
    pub(crate) fn value(&mut self, expression: &str) -> Value {
        self.try_value(expression).unwrap_or_else(|error| panic!("{expression}: {error}"))
    }

    /// The same, or the error that the browser answers.
    fn try_value(&mut self, expression: &str) -> Result<Value, Value> {
        let asked = json!({ "expression": expression, "returnByValue": true, "awaitPromise": true });
        let told = self.try_call("Runtime.evaluate", asked)?;
        assert!(told["exceptionDetails"].is_null(), "{expression}: {}", told["exceptionDetails"]);
        Ok(told["result"]["value"].clone())
    }

    /// Waits until the expression is true. A page that is just being replaced answers nothing, so it is asked again.
    pub(crate) fn wait(&mut self, what: &str, expression: &str) {
        let begin = Instant::now();
        loop {
            match self.try_value(expression) {
                Ok(value) if value == true => return,
                Err(error) if !is_of_navigation(&error) => panic!("{expression}: {error}"),
                _ => {}
            }
            if begin.elapsed() > PATIENCE {
                let text = self.value("document.body.innerText");
                panic!("no {what} ({expression}): {text}; {:?}", self.complaints);
            }
            std::thread::sleep(Duration::from_millis(50));
        }
    }

    /// Sets the size of the screen, and says whether it is a phone's.
    pub(crate) fn screen(&mut self, width: u32, height: u32, is_phone: bool) {
        let scale = if is_phone { 2 } else { 1 };
        let metrics =
            json!({ "width": width, "height": height, "deviceScaleFactor": scale, "mobile": is_phone });
        self.call("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// Clicks in the middle of an element, as a mouse does.
    pub(crate) fn click(&mut self, id: &str) {
        let middle = format!(
            "(() => {{ const r = document.getElementById('{id}').getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; }})()"
        );
        let at = self.value(&middle);
        for kind in ["mousePressed", "mouseReleased"] {
            let event = json!({ "type": kind, "x": at[0], "y": at[1], "button": "left", "clickCount": 1 });
            self.call("Input.dispatchMouseEvent", event);
        }
    }

    /// Types a text into what has the focus.
    pub(crate) fn type_in(&mut self, text: &str) {
        self.call("Input.insertText", json!({ "text": text }));
    }

    /// Presses and releases a key: a letter's, or one that has a name.
    pub(crate) fn press(&mut self, key: &str) {
        let down = match key {
            "Enter" => {
                json!({ "type": "keyDown", "key": key, "code": key, "text": "\r", "windowsVirtualKeyCode": 13 })
            }
            "Escape" => {
                json!({ "type": "keyDown", "key": key, "code": key, "windowsVirtualKeyCode": 27 })
            }
            "ArrowRight" => {
                json!({ "type": "keyDown", "key": key, "code": key, "windowsVirtualKeyCode": 39 })
            }
            letter => json!({ "type": "keyDown", "key": letter, "text": letter }),
        };
        self.call("Input.dispatchKeyEvent", down);
        self.call("Input.dispatchKeyEvent", json!({ "type": "keyUp", "key": key }));
    }

    /// Writes what the screen shows into a PNG file; with `whole`, also what is below it.
    pub(crate) fn picture(&mut self, file: &Path, whole: bool) {
        let told = self.call("Page.captureScreenshot", json!({ "captureBeyondViewport": whole }));
        let png = BASE64_STANDARD.decode(told["data"].as_str().unwrap()).unwrap();
        std::fs::write(file, png).unwrap();
    }
}

/// Whether an expression was not evaluated because its page was left meanwhile.
fn is_of_navigation(error: &Value) -> bool {
    let message = error["message"].as_str().unwrap_or_default();
    ["navigated", "context was destroyed", "find context", "find default execution context"]
        .iter()
        .any(|part| message.contains(part))
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}
