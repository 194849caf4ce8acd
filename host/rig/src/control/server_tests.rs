use super::*;
use crate::config::{Overrides, RigConfig};
use crate::control::change::{self, ChangeError};
use crate::control::client;
use crate::projectors::backend;
use crate::standing::{Identity, OrderFile};
use crate::telemetry::monitor::ProjectorHealth;
use dpm_common::folder::Owner;
use dpm_device::link::faults;
use dpm_device::planes::Raster;

/// Obeys orders as a link thread does.
fn link(monitor: &Arc<RunMonitor>, stop: &Arc<AtomicBool>) -> JoinHandle<()> {
    let (monitor, stop) = (monitor.clone(), stop.clone());
    std::thread::spawn(move || {
        while !stop.load(Ordering::Relaxed) {
            let health = match monitor.take_order() {
                Some(Order::Black) => ProjectorHealth::Black,
                Some(Order::Freeze) => ProjectorHealth::Frozen,
                Some(Order::Safe) => ProjectorHealth::Faulted(faults::HOST_SAFE),
                Some(Order::Arm) => ProjectorHealth::Up,
                None => {
                    std::thread::sleep(Duration::from_micros(200));
                    continue;
                }
            };
            monitor.set_projector(health);
        }
    })
}

/// A rig that listens, and a thread that obeys.
struct ListeningRig {
    dir: PathBuf,
    monitor: Arc<RunMonitor>,
    socket: Option<ControlSocket>,
    obeys: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl ListeningRig {
    fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("dpm-control-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&dir);
        let identity = Identity::of(&backend("mock").unwrap());
        let (file, error, _) = OrderFile::open(Some(dir.join("state")), identity);
        assert!(error.is_none(), "{error:?}");
        let monitor = Arc::new(RunMonitor::default());
        let orders = Arc::new(Orders::start(monitor.clone(), file, true, None).unwrap());
        let folder = Arc::new(Folder::make(&dir.join("run"), Owner::Own).unwrap());
        let socket = ControlSocket::serve(folder, monitor.clone(), orders).unwrap();
        let obeys = Arc::new(AtomicBool::new(false));
        let thread = link(&monitor, &obeys);
        Self { dir, monitor, socket: Some(socket), obeys, thread: Some(thread) }
    }

    fn socket(&self) -> PathBuf {
        self.socket.as_ref().unwrap().path()
    }

    fn tell(&self, order: Order) -> Result<client::OrderResult, client::ControlError> {
        client::tell_in(&[self.dir.join("run")], None, order)
    }

    /// Ends the thread that obeys.
    fn stop_link(&mut self) {
        self.obeys.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
    }
}

impl Drop for ListeningRig {
    fn drop(&mut self) {
        self.stop_link();
        self.socket = None;
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}

#[test]
fn parameters_are_shown_changed_and_refused_over_the_socket() {
    let rig = ListeningRig::new("parameters");
    let folders = [rig.dir.join("run")];
    let ask =
        |line: &str| change::change_in(&folders, None, &ParameterCommand::parse(line).unwrap().unwrap());
    assert!(matches!(ask("list"), Err(ChangeError::Refused(told)) if told.contains("no parameters")));
    let config = RigConfig::demo(&Overrides::default()).unwrap();
    let scene = Arc::new(crate::rig::Rig::build(&config, Raster::new(8, 8)).unwrap());
    let mut planning = rig.monitor.parameters().follow(&scene);
    rig.monitor.parameters().uses(u64::MAX, 7);
    assert_eq!(ask("set exposure=2.5").unwrap(), "ok: exposure is 2.5, from frame 7 on");
    assert_eq!(planning.latest().0.brighter, 2.5);
    let all = ask("list").unwrap();
    assert!(
        all.contains("exposure = 2.5") && all.contains("began with 1") && all.contains("body.bunny"),
        "{all}"
    );
    assert!(matches!(ask("set exposure=0"), Err(ChangeError::Refused(told)) if told.contains("0.000001")));
    assert!(matches!(ask("save"), Err(ChangeError::Refused(told)) if told.contains("no rig file")));
    assert_eq!(ask("undo").unwrap(), "ok: exposure is 1, from frame 7 on");
    assert!(matches!(ask("undo"), Err(ChangeError::Refused(_))));
    // No order was given by all this, and one still arrives.
    assert_eq!(rig.monitor.projector(), ProjectorHealth::Connecting);
    assert!(rig.tell(Order::Black).unwrap().is_done());
    let nobody = change::change_in(&folders, Some(1), &ParameterCommand::List);
    assert!(matches!(nobody, Err(ChangeError::NoRig { .. })));
}

#[test]
fn every_order_is_obeyed_and_bad_clients_cost_nothing() {
    let mut rig = ListeningRig::new("orders");
    assert_eq!(std::fs::metadata(rig.socket()).unwrap().permissions().mode() & 0o777, 0o600);
    // One client is silent, one never ends its line, and one sends nonsense.
    let mut silent = UnixStream::connect(rig.socket()).unwrap();
    let mut endless = UnixStream::connect(rig.socket()).unwrap();
    let _ = endless.write_all(&[b'x'; 4096]);
    let mut nonsense = UnixStream::connect(rig.socket()).unwrap();
    nonsense.write_all(b"light!\n").unwrap();
    for (order, word) in Order::ALL {
        // A FREEZE has no effect while the projector is black.
        if order == Order::Freeze {
            assert!(rig.tell(Order::Arm).unwrap().is_done());
        }
        let told = rig.tell(order).unwrap();
        assert!(told.is_done() && told.answers.len() == 1, "{word}: {told:?}");
        assert_eq!((told.answers[0].pid, told.answers[0].uid), (std::process::id(), user()));
        // Another test of this process may have set a rig file already.
        let names = ["built-in demo", crate::control::rig_name()];
        assert!(names.contains(&&*told.answers[0].rig), "{told:?}");
        assert_eq!(told.answers[0].text.contains("; kept in "), order != Order::Arm, "{told:?}");
        assert!(crate::control::is_obeyed(order, rig.monitor.projector()));
    }
    let mut told = String::new();
    nonsense.read_to_string(&mut told).unwrap();
    assert!(told.contains("known: black, freeze, safe, arm"), "{told}");
    silent.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    assert_eq!(silent.read(&mut [0; 8]).unwrap(), 0, "cut off");
    // If the projector does not obey, the answer says so.
    rig.stop_link();
    rig.monitor.set_projector(ProjectorHealth::Lost);
    for order in [Order::Black, Order::Arm] {
        let told = rig.tell(order).unwrap();
        assert!(!told.is_done() && told.answers[0].text.contains("not yet: projector lost"), "{told:?}");
    }
    rig.socket = None;
    let gone = rig.tell(Order::Arm).unwrap_err().to_string();
    assert!(gone.contains("no running rig listens") && gone.contains("nothing was armed"), "{gone}");
    assert!(rig.tell(Order::Black).unwrap_err().to_string().contains("no light was darkened"));
}

/// Found in use, R9: a thousand silent clients blocked `dpm safe` forever.
/// Orders among a thousand clients that say nothing; each takes `limit` at most.
fn silent_clients(limit: Duration) {
    let rig = ListeningRig::new("flood");
    let mut flood = Vec::new();
    for _ in 0..500 {
        // There may be too few descriptors for this process, which holds both ends.
        match UnixStream::connect(rig.socket()) {
            Ok(stream) => flood.push(stream),
            Err(_) => break,
        }
        if flood.len() == 400 {
            flood.drain(..300);
        }
    }
    for order in [Order::Black, Order::Arm, Order::Safe] {
        let begin = Instant::now();
        let told = rig.tell(order).unwrap();
        assert!(told.is_done(), "{told:?}");
        assert!(begin.elapsed() < limit, "{:?}", begin.elapsed());
        // More clients, of which the earlier ones are the oldest.
        flood.extend((0..100).map_while(|_| UnixStream::connect(rig.socket()).ok()));
    }
}

#[test]
fn only_the_rigs_user_and_root_may_give_orders() {
    for (client, me, may) in [(0, 0, true), (7, 7, true), (0, 7, true), (7, 0, false), (7, 8, false)] {
        assert_eq!(may_give_orders(client, me), may, "{client} {me}");
    }
}

/// A client that says nothing is dropped after seconds; an order that waited for all of them would take minutes.
#[test]
fn r9_a_thousand_silent_clients_hold_no_order_up() {
    silent_clients(Duration::from_secs(30));
}

mod real_pace {
    use super::*;

    #[test]
    fn r9_a_thousand_silent_clients_hold_an_order_up_by_a_second_and_a_half_at_most() {
        silent_clients(Duration::from_millis(1500));
    }
}
