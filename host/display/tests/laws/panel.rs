//! A display as a projector, at virtual pace on a card made of software: what is scanned out is what was packed, in the slot
//! that is told, and black whenever the light must end.

use std::sync::atomic::Ordering;

use crate::common::{with, DisplayRig};
use dpm_device::link::{faults, LinkState, Verb};
use dpm_device::time::{FrameRate, HostTime};
use dpm_display::encoding::Encoding;
use dpm_display::pacer::{NoPace, Pacer};

const BOTH: [Encoding; 2] = [Encoding::Rgb8, Encoding::Planes24];

/// Bits scanned out equal bits packed, each frame at the blank of its slot, once, whatever the crystal; and nothing else is
/// ever shown.
#[test]
fn every_frame_is_scanned_out_bit_for_bit_at_the_blank_of_its_slot() {
    for (encoding, ppm) in [(BOTH[0], 0), (BOTH[1], 90), (BOTH[0], -90)] {
        let mut rig = DisplayRig::new(encoding, |s| s.ppm = ppm);
        rig.stream();
        rig.send(60);
        rig.pass(60_000_000);
        let scanned = rig.scanned();
        for (id, slot) in &rig.sent {
            assert!(scanned.contains(&(*slot, Some(*id))), "frame {id} at blank {slot}: {scanned:?}");
        }
        let first = rig.sent[0].1;
        assert!(scanned.iter().all(|(blank, frame)| *blank >= first || frame.is_none()), "starts dark");
        let counts = rig.cable.device().counts();
        assert_eq!(counts.missed.load(Ordering::Relaxed), 0);
        assert_eq!(with(&rig.shared, |s| s.torn), 0);
        let status = rig.cable.device().firmware().status();
        assert_eq!((status.frames_lit, status.frames_superseded, status.frames_late), (60, 0, 0));
    }
}

/// A picture that the display does not take in time is shown one blank later, is told so, and is counted once.
#[test]
fn missed_flips_are_counted_exactly_and_told_in_the_slot_that_showed_them() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(20);
    // Blanks to come at which a waiting picture is not taken: one alone, and two in a row.
    let (newest, number) = with(&rig.shared, |s| s.scanned.last().unwrap().sequence)
        .pipe(|sequence| (sequence, rig.cable.device().pacer().unwrap().number(sequence)));
    let misses = [6u32, 12, 13];
    with(&rig.shared, |s| s.missed = misses.iter().map(|k| newest.wrapping_add(*k)).collect());
    rig.send(30);
    rig.pass(60_000_000);
    let scanned = rig.scanned();
    let at = |blank: u64| scanned.iter().find(|(b, _)| *b == blank).unwrap().1;
    let meant = |blank: u64| rig.sent.iter().find(|(_, slot)| *slot == blank).map(|(id, _)| *id);
    for (id, slot) in &rig.sent {
        let ahead = slot.saturating_sub(number) as u32;
        let shown = match ahead {
            // Late by exactly one, and by exactly two; what was meant for these blanks is superseded.
            7 => meant(slot - 1),
            14 => meant(slot - 2),
            6 | 12 => meant(slot - 1),
            13 => meant(slot - 2),
            _ => Some(*id),
        };
        assert_eq!(at(*slot), shown, "blank {slot}, {ahead} after the newest");
    }
    let counts = rig.cable.device().counts();
    assert_eq!(counts.missed.load(Ordering::Relaxed), 3);
    let status = rig.cable.device().firmware().status();
    assert_eq!(status.slots_repeated - repeated_at_the_end(&rig), 3);
    assert_eq!((status.frames_lit, status.frames_superseded), (47, 3));
}

/// Slots after the last frame, which show it again.
fn repeated_at_the_end(rig: &DisplayRig) -> u32 {
    let status = rig.cable.device().firmware().status();
    let last = rig.sent.last().unwrap().1;
    let slots = rig.slot() - last;
    assert!(slots <= u64::from(status.slots_repeated));
    slots as u32
}

trait Pipe: Sized {
    fn pipe<R>(self, f: impl FnOnce(Self) -> R) -> R {
        f(self)
    }
}
impl<T> Pipe for T {}

/// A thread that sleeps through blanks shows nothing wrong, and the slots that it slept through are counted.
#[test]
fn a_thread_that_is_late_counts_every_slot_that_it_missed() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(10);
    let before = rig.cable.device().counts().missed.load(Ordering::Relaxed);
    assert_eq!(before, 0);
    let slot = rig.slot();
    rig.sleep(75_000_000);
    let now = rig.now();
    rig.cable.device_mut().advance(now);
    let slept = rig.slot() - slot;
    assert!((4..=5).contains(&slept));
    rig.send(10);
    rig.pass(40_000_000);
    // The picture on its way was taken; those of the slots that were slept through were not made, and the newest may have come
    // behind its blank.
    let missed = rig.cable.device().counts().missed.load(Ordering::Relaxed);
    let scanned = rig.scanned();
    let status = rig.cable.device().firmware().status();
    let shown: std::collections::BTreeSet<u64> = scanned.iter().filter_map(|(_, frame)| *frame).collect();
    assert!((slept - 1..=slept).contains(&missed), "{missed} missed of {slept}");
    assert_eq!(shown.len() as u32, status.frames_lit, "every frame that is told was shown");
}

/// A picture that is told to be taken only after the next slot has begun leaves that slot without a picture: it is counted.
#[test]
fn a_slot_that_begins_before_the_picture_on_its_way_is_told_is_counted() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(10);
    let counts = rig.cable.device().counts();
    let [taken, missed] = [&counts.taken, &counts.missed].map(|n| n.load(Ordering::Relaxed));
    // A slot begins 10.7 ms after the blank of the one before.
    let slot = rig.slot();
    with(&rig.shared, |s| s.told_late_ns = 12_000_000);
    rig.pass(400_000_000);
    with(&rig.shared, |s| s.told_late_ns = 0);
    rig.pass(40_000_000);
    let slots = rig.slot() - slot;
    let [taken, missed] = [(&counts.taken, taken), (&counts.missed, missed)]
        .map(|(n, before)| n.load(Ordering::Relaxed) - before);
    assert!(missed >= 8, "{missed} missed of {slots}");
    // A picture may be on its way at either end.
    assert!((taken + missed).abs_diff(slots) <= 1, "{slots} slots, {taken} pictures taken, {missed} missed");
}

/// Every way in which the light must end is black at the next blank but one.
#[test]
fn light_ends_black() {
    for way in ["order", "silence", "end"] {
        let mut rig = DisplayRig::new(Encoding::Planes24, |_| {});
        rig.stream();
        rig.send(20);
        assert!(!with(&rig.shared, |s| s.is_black), "{way}");
        let now = rig.now();
        match way {
            "order" => rig.link.command(now, Verb::Black, &mut rig.cable).unwrap(),
            "end" => rig.link.command(now, Verb::Stop, &mut rig.cable).unwrap(),
            // The host says nothing more: the watchdog of 100 ms.
            _ => rig.pass(100_000_000),
        }
        rig.pass(36_000_000);
        assert!(with(&rig.shared, |s| s.is_black), "{way}");
        let bitten = rig.cable.device().firmware().status().faults & faults::WATCHDOG != 0;
        assert_eq!(bitten, way == "silence");
        let scanned = rig.scanned();
        let dark = scanned.iter().rev().take_while(|(_, frame)| frame.is_none()).count();
        assert!(dark >= 1, "{way}: {dark}");
    }
}

/// An end that nobody ordered, a panic's too, is black before the call returns.
#[test]
fn a_panel_that_is_dropped_leaves_black() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(5);
    assert!(!with(&rig.shared, |s| s.is_black));
    let shared = rig.shared.clone();
    let died = std::panic::catch_unwind(std::panic::AssertUnwindSafe(move || {
        let _rig = rig;
        panic!("on purpose");
    }));
    assert!(died.is_err() && with(&shared, |s| s.is_black));
}

/// A pulled cable, blanks that stop, and a driver that does not count end the scan-out, in the dark, with the reason.
#[test]
fn a_lost_display_is_told_and_dark() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(5);
    with(&rig.shared, |s| s.is_plugged = false);
    rig.pass(300_000_000);
    let panel = rig.cable.device();
    assert!(panel.is_lost() && panel.counts().lost().unwrap().contains("unplugged"));
    assert!(with(&rig.shared, |s| s.is_black));

    let mut rig = DisplayRig::new(Encoding::Rgb8, |_| {});
    rig.stream();
    rig.send(5);
    with(&rig.shared, |s| s.is_stuck = true);
    rig.pass(600_000_000);
    let panel = rig.cable.device();
    assert!(panel.is_lost() && panel.counts().lost().unwrap().contains("vertical blank"));
    assert!(with(&rig.shared, |s| s.is_black));

    let mut rig = DisplayRig::new(Encoding::Rgb8, |s| s.counts_none = true);
    rig.pass(300_000_000);
    let panel = rig.cable.device();
    assert!(panel.is_lost() && panel.counts().lost().unwrap().contains("does not count"));

    // Half a percent off is a crystal; five percent is another rate.
    let mut rig = DisplayRig::new(Encoding::Rgb8, |s| s.ppm = 50_000);
    rig.pass(1_300_000_000);
    assert!(rig.cable.device().counts().lost().unwrap().contains("variable refresh"));
}

/// Stamps that come late by up to a third of a frame spoil the rate of the first blanks, not the start.
#[test]
fn stamps_that_jitter_are_learned_from_more_blanks() {
    let rate = FrameRate::new(60, 1).unwrap();
    let first: Vec<_> = (0..6u32).map(|k| (k, HostTime(i64::from(k) * 16_666_667))).collect();
    let late = first.iter().map(|(k, at)| (*k, at.plus_ns(if *k == 5 { 5_000_000 } else { 0 })));
    assert!(matches!(Pacer::learn(rate, 0, &late.collect::<Vec<_>>()), Err(NoPace::OtherRate { .. })));
    let mut rig = DisplayRig::new(Encoding::Rgb8, |s| s.jitter_ns = 5_000_000);
    rig.stream();
    rig.send(30);
    assert!(!rig.cable.device().is_lost());
}

/// The host's map of the projector's clock is that of the blanks: what STATUS calls the start of a slot is so much before the
/// blank that showed the frame, whatever the crystal.
#[test]
fn stamps_are_those_of_the_blanks() {
    let mut rig = DisplayRig::new(Encoding::Rgb8, |s| s.ppm = 150);
    rig.stream();
    rig.send(100);
    let status = rig.cable.device().firmware().status();
    let (clock, slots) = (rig.cable.device().pacer().unwrap().clock(), rig.link.slots().unwrap());
    let slot = slots.slot_at(status.last_lit_at).unwrap();
    let told = clock.instant_of(status.last_lit_at);
    let blank = rig.cable.device().pacer().unwrap().blank_at(slot);
    // 3 ms and half of the 6 ms of blank.
    assert!((blank.ns_since(told) - 6_000_000).abs() < 1_000_000, "{}", blank.ns_since(told));
    let scanned = rig.scanned();
    let index = scanned.iter().position(|(b, _)| *b == slot);
    if let Some(index) = index {
        let at_ns = with(&rig.shared, |s| s.scanned[s.scanned.len() - scanned.len() + index].at_ns);
        assert!((blank.0 - at_ns).abs() < 5_000, "{} ns off", blank.0 - at_ns);
    }
    assert_eq!(rig.link.state(), LinkState::Streaming);
}
