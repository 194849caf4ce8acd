//! What the dry run judges, fed with faults.

use dpm_render::gpu::MemoryPlace;
use gpu_compile::rehearsal::{machine_wakes_late_ms, misplaced, too_large, Share, MOST_OF_A_SLOT_MS};

#[test]
fn each_kind_of_wrong_memory_is_named() {
    let good = MemoryPlace { on_device: true, host_visible: false, host_cached: false };
    let host = MemoryPlace { on_device: false, host_visible: true, host_cached: true };
    let all = [("instances", good), ("counters of the host", host)];
    assert!(misplaced(&all).is_empty());
    for (name, place, fault) in [
        ("instances", host, "across the bus"),
        ("counters of the host", good, "cannot read"),
        ("counters of the host", MemoryPlace { host_cached: false, ..host }, "without its caches"),
    ] {
        let wrong = misplaced(&[all[0], (name, place), all[1]]);
        assert!(wrong.len() == 1 && wrong[0].contains(name) && wrong[0].contains(fault), "{wrong:?}");
    }
}

#[test]
fn a_host_that_takes_too_much_of_a_slot_is_named_by_its_method() {
    let share = |method: &str, taken: f64| Share {
        method: method.into(),
        runs: 1,
        frames: 1000,
        missed: 0,
        // Frames that wait once: each part alone may come near the limit.
        plan_ms: [0.0, MOST_OF_A_SLOT_MS * 0.9],
        readable_ms: [0.0, MOST_OF_A_SLOT_MS * 0.9],
        taken_ms: [0.0, taken],
    };
    let all =
        [share("full", MOST_OF_A_SLOT_MS), share("dpm", MOST_OF_A_SLOT_MS * 1.01), share("paper", f64::NAN)];
    let over = too_large(&all);
    assert_eq!(over.len(), 2, "{over:?}");
    assert!(over[0].starts_with("dpm:") && over[1].starts_with("paper:"), "{over:?}");
}

#[test]
fn a_machine_never_wakes_a_thread_early() {
    for is_awake in [true, false] {
        let [median, most] = machine_wakes_late_ms(50, is_awake).unwrap();
        assert!(0.0 < median && median <= most && most < 1000.0, "{median} {most}");
    }
}
