//! Interlock and limits on a running rig at real pace: dark when something else demands it, and light again only if
//! nobody ordered otherwise.

use crate::link_common::{raster, rig, served_time, start_with, Projector, PtyProjector};
use dpm_device::link::DeviceState;
use dpm_rig::interlock::{Contact, Interlock};
use dpm_rig::order::Order;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use hil_mock::projector::MockConfig;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

const LONG: Duration = Duration::from_secs(20);

/// Closed while the flag is set.
struct LimitContact(Arc<AtomicBool>);

impl Contact for LimitContact {
    fn is_closed(&mut self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

fn projector(name: &str) -> PtyProjector {
    PtyProjector::new(name, MockConfig::new(raster()))
}

#[test]
fn an_open_interlock_is_dark_within_50_ms_and_a_closed_one_is_light_where_nobody_ordered_otherwise() {
    let far = projector("interlock");
    let closed = Arc::new(AtomicBool::new(true));
    let switch = LimitContact(closed.clone());
    let run = start_with(&rig(&far.backend(""), &[]), 0, |monitor| {
        monitor.set_interlock(Interlock::with_contact("a switch", switch).unwrap());
    });
    let lit = || far.until(LONG, "light", &mut |s| s.lit);
    let opens = || {
        closed.store(false, Ordering::Relaxed);
        let took = served_time("dark", || !far.is_lit());
        assert!(took <= Duration::from_millis(50), "{took:?}");
        let told = served_time("told", || run.monitor.projector() == ProjectorHealth::InterlockOpen);
        assert!(told <= Duration::from_millis(50), "{told:?}");
    };
    let stays_dark = || {
        for _ in 0..150 {
            assert!(!far.is_lit());
            std::thread::sleep(Duration::from_millis(1));
        }
    };
    for _ in 0..3 {
        lit();
        opens();
        // BLACK, not SAFE: nothing is latched, and frames continue.
        far.until(LONG, "black", &mut |s| s.state == DeviceState::Black && s.faults == 0);
        stays_dark();
        // An ARM does not overrule it.
        run.monitor.give_order(Order::Arm);
        stays_dark();
        closed.store(true, Ordering::Relaxed);
        lit();
    }
    // An order that was given before or meanwhile stands when the interlock closes.
    for order in [Order::Black, Order::Freeze] {
        for before in [true, false] {
            lit();
            if before {
                run.monitor.give_order(order);
                far.until(LONG, "ordered", &mut |s| s.state != DeviceState::Armed);
            }
            closed.store(false, Ordering::Relaxed);
            served_time("dark", || !far.is_lit());
            if !before {
                run.monitor.give_order(order);
            }
            stays_dark();
            closed.store(true, Ordering::Relaxed);
            served_time("told", || run.monitor.projector() == ProjectorHealth::Black);
            stays_dark();
            run.monitor.give_order(Order::Arm);
        }
    }
    lit();
    opens();
    // A projector that comes back while the interlock is open stays dark.
    far.unplug();
    std::thread::sleep(Duration::from_millis(150));
    far.plug_in();
    far.until(LONG, "configured", &mut |s| s.state == DeviceState::Configured);
    stays_dark();
    closed.store(true, Ordering::Relaxed);
    lit();
    run.stop().unwrap_or_else(|e| panic!("{e}"));
    assert!(!far.is_lit());
}

#[test]
fn a_run_whose_interlock_is_open_from_the_start_makes_no_light() {
    let far = projector("interlock-open");
    let closed = Arc::new(AtomicBool::new(false));
    let switch = LimitContact(closed.clone());
    let run = start_with(&rig(&far.backend(""), &[]), 0, |monitor| {
        monitor.set_interlock(Interlock::with_contact("a switch", switch).unwrap());
    });
    far.until(LONG, "black", &mut |s| s.state == DeviceState::Black);
    for _ in 0..300 {
        let s = far.status();
        assert_eq!((s.lit, s.frames_lit), (false, 0));
        std::thread::sleep(Duration::from_millis(1));
    }
    closed.store(true, Ordering::Relaxed);
    far.until(LONG, "light", &mut |s| s.lit);
    run.stop().unwrap_or_else(|e| panic!("{e}"));
}

#[test]
fn a_limit_darkens_the_run_by_name_counts_its_frames_and_lets_light_come_back() {
    let far = projector("limits");
    // About half of the moving pattern is lit, so a limit of a hundredth of full white is reached at once.
    let flags =
        ["safety.limits.mean_level=0.01", "safety.limits.mean_window_s=0.5", "safety.flashes_per_second=0"];
    let run = start_with(&rig(&far.backend(""), &flags), 0, |_| {});
    far.until(LONG, "black", &mut |s| s.state == DeviceState::Black);
    served_time("told", || matches!(run.monitor.projector(), ProjectorHealth::Resting(_)));
    let told = run.monitor.projector().to_string();
    assert!(told.contains("safety.limits.mean_level"), "{told}");
    // After the rest of two seconds the light returns and ends again.
    far.until(LONG, "armed again", &mut |s| s.state == DeviceState::Armed);
    far.until(LONG, "black again", &mut |s| s.state == DeviceState::Black);
    assert_eq!(far.status().faults, 0, "the host strikes before the projector");
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    assert!(report.projector.expect("the link was used").not_sent[5] > 100);
}
