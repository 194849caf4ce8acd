//! The word for the light is that of the light: on every cause of darkness, the state, the metrics and the report of a
//! running rig agree with the mirrors of the projector.

use super::hangs::{threads, HaltedThread};
use crate::cli_common::{code, dpm, err, start, ChildProgram, TestFolder};
use crate::cli_run::natnet;
use crate::link_common::{raster, rig, start_with, Projector, PtyProjector};
use dpm_device::link::{faults, LimitReached};
use dpm_rig::interlock::{Contact, Interlock};
use dpm_rig::order::Order;
use dpm_rig::telemetry::light_state::{Darkness, LightState};
use dpm_rig::telemetry::monitor::ProjectorHealth;
use hil_mock::motion::MotionSpec;
use hil_mock::projector::MockConfig;
use serde_json::Value;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// How long a state may take to come on a busy machine, with shaders to compile.
const LONG: Duration = Duration::from_secs(120);

/// A mirror is lit.
fn has_light(far: &PtyProjector) -> bool {
    let mut lit = false;
    far.look(&mut |m| lit = m.is_lit() && m.lit_planes().is_some_and(|p| p.iter().any(|byte| *byte != 0)));
    lit
}

/// Closed while the flag is set.
struct WordContact(Arc<AtomicBool>);

impl Contact for WordContact {
    fn is_closed(&mut self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

#[test]
fn orders_interlock_limit_fault_and_a_lost_cable_are_called_by_their_name() {
    let far = PtyProjector::new("words", MockConfig::new(raster()));
    let closed = Arc::new(AtomicBool::new(true));
    let switch = WordContact(closed.clone());
    let run = start_with(&rig(&far.backend(""), &[]), 0, |monitor| {
        monitor.set_interlock(Interlock::with_contact("a switch", switch).unwrap());
        assert_eq!(monitor.light(), LightState::NeverArmed(ProjectorHealth::Connecting));
    });
    let told = |state: LightState| {
        run.until(state.word(), |monitor| monitor.light() == state && has_light(&far) == state.is_lit());
    };
    let lit = LightState::Lit { is_held: false };
    told(lit);
    for order in [Order::Black, Order::Safe] {
        run.monitor.give_order(order);
        told(LightState::DarkByOrder(order));
        run.monitor.give_order(Order::Arm);
        told(lit);
    }
    run.monitor.give_order(Order::Freeze);
    told(LightState::Lit { is_held: true });
    run.monitor.give_order(Order::Arm);
    closed.store(false, Ordering::Relaxed);
    told(LightState::Dark(Darkness::Projector(ProjectorHealth::InterlockOpen)));
    closed.store(true, Ordering::Relaxed);
    told(lit);
    far.look(&mut |m| m.set_faults(m.now(), faults::OVER_TEMPERATURE));
    told(LightState::Dark(Darkness::Projector(ProjectorHealth::Faulted(faults::OVER_TEMPERATURE))));
    far.look(&mut |m| m.set_faults(m.now(), 0));
    run.monitor.give_order(Order::Arm);
    told(lit);
    far.unplug();
    told(LightState::Dark(Darkness::Projector(ProjectorHealth::Lost)));
    far.plug_in();
    told(lit);
    let monitor = run.monitor.clone();
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    assert_eq!(monitor.light(), LightState::Dark(Darkness::Over));
    for name in ["lit", "dark_by_order", "dark"] {
        assert!(report.light_s[name] > 0.0, "{name}: {:?}", report.light_s);
    }
    assert_eq!(report.light_s.len(), LightState::WORDS.len());
}

#[test]
fn a_limit_is_called_by_its_name() {
    let far = PtyProjector::new("word-limit", MockConfig::new(raster()));
    let flags =
        ["safety.limits.mean_level=0.01", "safety.limits.mean_window_s=0.5", "safety.flashes_per_second=0"];
    let run = start_with(&rig(&far.backend(""), &flags), 0, |_| {});
    let rests = LightState::Dark(Darkness::Projector(ProjectorHealth::Resting(LimitReached::Mean)));
    run.until("a rest", |monitor| monitor.light() == rests && !has_light(&far));
    assert!(run.monitor.light_told().contains("safety.limits.mean_level"), "{}", run.monitor.light_told());
    run.stop().unwrap_or_else(|e| panic!("{e}"));
}

/// A running rig whose page is asked.
struct PageWatch<'a> {
    address: SocketAddr,
    far: &'a PtyProjector,
}

impl PageWatch<'_> {
    fn get(&self, path: &str) -> Option<String> {
        let mut stream = TcpStream::connect(self.address).ok()?;
        stream.set_read_timeout(Some(LONG)).ok()?;
        let host = self.address;
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n").ok()?;
        let mut text = String::new();
        stream.read_to_string(&mut text).ok()?;
        Some(text.split_once("\r\n\r\n")?.1.to_owned())
    }

    fn state(&self) -> Option<Value> {
        serde_json::from_str(&self.get("/api/state")?).ok()
    }

    /// Waits until the state says `word`, and the metrics and the mirrors agree. Returns the state.
    fn agrees(&self, word: &str) -> Value {
        let (begin, mut last) = (Instant::now(), None);
        let name = LightState::name_of(word);
        while begin.elapsed() < LONG {
            last = self.state();
            if let Some(state) = last.as_ref().filter(|state| state["now"]["light"]["word"] == word) {
                let metrics = self.get("/metrics").unwrap_or_default();
                let of = |word: &str, value: u8| {
                    metrics.contains(&format!(
                        "dpm_light_state{{state=\"{}\"}} {value}\n",
                        LightState::name_of(word)
                    ))
                };
                let agree = LightState::WORDS.iter().all(|other| of(other, u8::from(*other == word)));
                let is_lit = state["now"]["light"]["is_lit"] == true;
                assert_eq!(is_lit, word.ends_with("LIT"), "{state}");
                if agree && has_light(self.far) == is_lit && state["now"]["light"]["state"] == name.as_str() {
                    return state.clone();
                }
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        panic!("never {word}, mirrors lit: {}; {last:?}", has_light(self.far));
    }
}

fn order(word: &str, run: &ChildProgram) {
    let output = dpm(&[word, "--pid", &run.id().to_string()], &[]);
    assert_eq!(code(&output), 0, "{}", err(&output));
}

/// Starts a rig of two bodies, of which the server at `port` serves the bunny alone. `safety`: what else its file says of `[safety]`.
fn start_asked<'a>(
    folder: &TestFolder,
    far: &'a PtyProjector,
    port: u16,
    safety: &str,
) -> (ChildProgram, PageWatch<'a>) {
    // Free for a moment at least, and nobody else in this test asks for one.
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let rig = folder.write(
        "rig.toml",
        &format!(
            "[projector]\nwidth = {}\nheight = {}\nframe_rate = 30\nplanes = 8\nbackend = {}\n[render]\nspp = 1\n\
             method = \"full\"\n[safety]\npredict_ms = 100\n{safety}\n[output]\ndir = {:?}\nlog_every_s = 0.5\n\
             [tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\ncommand_port = {}\n\
             [[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n[page]\nlisten = \"{address}\"\n",
            raster().width(),
            raster().height(),
            far.backend(""),
            folder.text(),
            port,
        ),
    );
    (start(&["run", &rig]), PageWatch { address, far })
}

/// The page of a rig whose light rests again and again says so, and why.
#[test]
fn a_limit_is_called_by_its_name_on_the_page() {
    let folder = TestFolder::new("word-rests");
    let far = PtyProjector::new("word-rests", MockConfig::new(raster()));
    let server = natnet(&MotionSpec::Still {}, [0.0, 0.1, 0.0]);
    let limits = "flashes_per_second = 0\nlimits = { mean_level = 0.002, mean_window_s = 3.0 }";
    let (run, asked) = start_asked(&folder, &far, server.address().port(), limits);
    let begin = Instant::now();
    while !asked.agrees("DARK")["now"]["light"]["told"].as_str().unwrap().contains("safety.limits.mean_level")
    {
        assert!(begin.elapsed() < LONG, "it never rests");
    }
    asked.agrees("PARTLY LIT");
    run.signal("TERM");
}

/// Found in use, O1: a rig without a tracker was green, up and lit, and so was one whose stages hung for 92 s.
#[test]
fn a_start_by_hand_an_interlock_a_lost_body_a_hung_stage_and_a_silent_tracker_are_called_by_their_name() {
    let folder = TestFolder::new("word");
    let far = PtyProjector::new("word", MockConfig::new(raster()));
    // It serves the bunny alone.
    let server = natnet(&MotionSpec::Still {}, [0.0, 0.1, 0.0]);
    let contact = folder.write("contact", "1");
    let by_hand = format!("start = \"by hand\"\ninterlock = {{ kind = \"line\", file = {contact:?} }}");
    let (mut run, asked) = start_asked(&folder, &far, server.address().port(), &by_hand);
    // First the projector is connected, and then the start waits for a person.
    let begin = Instant::now();
    while !asked.agrees("NEVER ARMED")["now"]["light"]["told"].as_str().unwrap().contains("safety.start") {
        assert!(begin.elapsed() < LONG, "it waits for nobody");
    }
    order("arm", &run);
    let state = asked.agrees("PARTLY LIT");
    let told = state["now"]["light"]["told"].as_str().unwrap().to_owned();
    assert!(told.starts_with("venus: ") && !told.contains("bunny"), "{told}");
    run.wait_for_line(LONG, |line| line.contains("\"light\":\"partly_lit\""));
    order("black", &run);
    asked.agrees("DARK BY ORDER");
    order("arm", &run);
    asked.agrees("PARTLY LIT");
    folder.write("contact", "0");
    let state = asked.agrees("DARK");
    let told = state["now"]["light"]["told"].as_str().unwrap();
    assert!(told.contains("safety.interlock"), "{told}");
    folder.write("contact", "1");
    asked.agrees("PARTLY LIT");
    // A stage hangs, and so does the supervisor, which would replace it before the light had been gone for a second.
    let all = threads(run.id());
    let stopped = ["dpm-supervisor", "dpm-pack"].map(|wanted| {
        let (thread, _) =
            all.iter().find(|(_, name)| name == wanted).unwrap_or_else(|| panic!("{wanted}: {all:?}"));
        HaltedThread::new(*thread).expect("it may be traced")
    });
    asked.agrees("STALLED");
    drop(stopped);
    asked.agrees("PARTLY LIT");
    // The tracker falls silent.
    drop(server);
    let state = asked.agrees("DARK");
    let told = state["now"]["light"]["told"].as_str().unwrap();
    assert!(told.contains("bunny: the tracker has not reported it") && told.contains("venus: "), "{told}");
    let metrics = asked.get("/metrics").unwrap();
    assert!(metrics.contains("dpm_body_lit{body=\"bunny\"} 0\n"), "{metrics}");
    run.wait_for_line(LONG, |line| line.contains("\"light\":\"dark\""));
    run.signal("TERM");
}
