use super::*;
use crate::config::{Overrides, RigConfig};
use crate::projectors::backend;
use crate::rig::Rig;
use crate::standing::{Identity, OrderFile};
use dpm_device::planes::Raster;

const TOKEN: &str = "abc-012345-XYZ";

struct OscBench {
    monitor: Arc<RunMonitor>,
    osc: OscSocket,
    to: UdpSocket,
}

impl OscBench {
    fn new(sender: &str, token: Option<&str>) -> Self {
        let config = RigConfig::demo(&Overrides::default()).unwrap();
        let rig = Arc::new(Rig::build(&config, Raster::new(8, 8)).unwrap());
        let monitor = Arc::new(RunMonitor::default());
        let _ = monitor.parameters().follow(&rig);
        let identity = Identity::of(&backend("mock").unwrap());
        let (file, _, _) = OrderFile::open(None, identity);
        let orders = Arc::new(Orders::start(monitor.clone(), file, false, None).unwrap());
        let osc = {
            let (any, token) = ("127.0.0.1:0".parse().unwrap(), token.map(str::to_owned));
            OscSocket::serve(any, vec![], token, monitor.clone(), orders).unwrap()
        };
        let to = UdpSocket::bind((sender, 0)).unwrap();
        to.connect(osc.address()).unwrap();
        Self { monitor, osc, to }
    }

    fn send(&self, address: &str, numbers: &[f32]) {
        let padded = |text: &str| {
            let mut bytes = text.as_bytes().to_vec();
            bytes.resize((bytes.len() / 4 + 1) * 4, 0);
            bytes
        };
        let mut bytes = [padded(address), padded(&format!(",{}", "f".repeat(numbers.len())))].concat();
        numbers.iter().for_each(|n| bytes.extend(n.to_be_bytes()));
        self.to.send(&bytes).unwrap();
    }

    /// Waits until `is` says so.
    fn wait(&self, what: &str, mut is: impl FnMut() -> bool) {
        let begin = Instant::now();
        while !is() {
            assert!(begin.elapsed() < Duration::from_secs(20), "no {what}");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn exposure(&self) -> f64 {
        self.monitor.parameters().shown().unwrap().all[0].numbers[0]
    }
}

#[test]
fn parameters_and_dark_orders_are_carried_out_and_arm_is_not() {
    let bench = OscBench::new("127.0.0.1", Some(TOKEN));
    let with_token = |name: &str| format!("/dpm/token/{TOKEN}/{name}");
    bench.send(&with_token("exposure"), &[1.25]);
    bench.wait("exposure", || bench.exposure() == 1.25);
    for (address, order) in [
        (with_token("freeze"), Order::Freeze),
        ("/dpm/black".into(), Order::Black),
        ("/dpm/safe".into(), Order::Safe),
    ] {
        bench.send(&address, &[1.0]);
        let mut taken = None;
        bench.wait(&address, || {
            taken = taken.or(bench.monitor.take_order());
            taken.is_some()
        });
        assert_eq!(taken, Some(order));
    }
    let mut notes = Vec::new();
    bench.send(&with_token("arm"), &[1.0]);
    // A release of a button, and what follows it in order.
    bench.send("/dpm/black", &[0.0]);
    bench.send(&with_token("exposure"), &[0.0]);
    bench.wait("refusals", || {
        notes.extend(bench.monitor.take_notes());
        notes.iter().any(|n| n.contains("must be 0.000001"))
    });
    assert_eq!(bench.monitor.take_order(), None, "{notes:?}");
    assert_eq!(bench.exposure(), 1.25);
    assert!(notes.iter().any(|n| n.contains("exposure is 1.25")), "{notes:?}");
    assert!(notes.iter().any(|n| n.contains("ARM is never") || n.contains("and 1 more")), "{notes:?}");
}

/// Found in use, R5 and R14: any user of the machine could set the exposure.
#[test]
fn without_the_right_token_osc_only_makes_dark() {
    let wrong = format!("/dpm/token/{}/", TOKEN.replace('X', "x"));
    for (token, prefix) in
        [(None, "/dpm/"), (None, "/dpm/token/abc-012345-XYZ/"), (Some(TOKEN), "/dpm/"), (Some(TOKEN), &wrong)]
    {
        let bench = OscBench::new("127.0.0.1", token);
        let before = bench.exposure();
        bench.send(&format!("{prefix}exposure"), &[1.25]);
        bench.send(&format!("{prefix}freeze"), &[1.0]);
        bench.send(&format!("{prefix}black"), &[1.0]);
        let mut orders = Vec::new();
        bench.wait("black", || {
            orders.extend(bench.monitor.take_order());
            orders.contains(&Order::Black)
        });
        // What came before it was refused.
        assert_eq!((orders, bench.exposure()), (vec![Order::Black], before));
        let mut notes = Vec::new();
        bench.wait("refusal", || {
            notes.extend(bench.monitor.take_notes());
            notes.iter().any(|note| note.contains("osc.token"))
        });
        assert!(!notes.iter().any(|note| note.contains("012345")), "{notes:?}");
    }
}

#[test]
fn a_flood_of_anything_is_told_in_few_notes_and_black_still_arrives() {
    let bench = OscBench::new("127.0.0.1", None);
    for k in 0..3000u32 {
        let _ = bench.to.send(&k.to_be_bytes().repeat(k as usize % 100));
    }
    let mut notes = 0;
    bench.wait("order", || {
        bench.send("/dpm/black", &[]);
        notes += bench.monitor.take_notes().iter().filter(|n| n.contains("refused")).count();
        bench.monitor.take_order() == Some(Order::Black)
    });
    assert!(notes <= 21, "{notes} notes");
}

#[test]
fn a_sender_that_is_not_listed_is_not_heard() {
    let bench = OscBench::new("127.0.0.1", None);
    let mut ear = Ear {
        socket: UdpSocket::bind("127.0.0.1:0").unwrap(),
        door: Doorkeeper { from: vec!["192.0.2.7".parse().unwrap()], token: None },
        monitor: bench.monitor.clone(),
        orders: {
            let identity = Identity::of(&backend("mock").unwrap());
            let (file, _, _) = OrderFile::open(None, identity);
            Arc::new(Orders::start(bench.monitor.clone(), file, false, None).unwrap())
        },
        waiting: Vec::new(),
        refused: Refusals::default(),
    };
    let black = b"/dpm/black\0\0,\0\0\0";
    for (from, is_heard) in [
        ("192.0.2.8:9", false),
        ("[2001:db8::1]:9", false),
        ("192.0.2.7:9", true),
        ("[::ffff:192.0.2.7]:9", true),
        // This machine is as every other one where machines are named.
        ("127.0.0.9:9", false),
    ] {
        ear.hear(black, from.parse().unwrap());
        assert_eq!(bench.monitor.take_order().is_some(), is_heard, "{from}");
    }
    assert_eq!(ear.refused.count, 3);
    ear.door.from.clear();
    for (from, is_heard) in [("127.0.0.9:9", true), ("[::1]:9", true), ("192.0.2.7:9", false)] {
        ear.hear(black, from.parse().unwrap());
        assert_eq!(bench.monitor.take_order().is_some(), is_heard, "{from}");
    }
    drop(bench.osc);
}
