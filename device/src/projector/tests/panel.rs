//! A panel that takes frames late, and a clock that is corrected.

use super::*;

/// Slots, counts and light of a projector whose panel is `busy` at the start of the slots that are named, and takes every
/// frame at once otherwise.
fn shown(busy_at: &[u64]) -> (Vec<(u64, LightKind, Option<u32>)>, Status) {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    let first = rig.slot + 3;
    for id in 0..12u64 {
        rig.step(id);
        let device = rig.cable.device_mut();
        device.panel_busy((rig.slot + 1).checked_sub(first).is_some_and(|slot| busy_at.contains(&slot)));
    }
    let device = rig.cable.device_mut();
    let events = std::iter::from_fn(|| device.next_light());
    let told = events.filter(|e| e.slot >= first).map(|e| (e.slot - first, e.kind, e.frame)).collect();
    device.check_laws();
    (told, device.status())
}

/// A frame that the panel did not take in its slot is told one slot later, the slot shows the frame before, and the frame
/// that had been meant for the later slot is superseded.
#[test]
fn a_frame_that_misses_its_flip_is_late_by_exactly_one() {
    let (clean, all) = shown(&[]);
    assert!(clean.iter().all(|(_, kind, _)| *kind == LightKind::Lit), "{clean:?}");
    assert_eq!((all.slots_repeated, all.frames_superseded), (0, 0));
    let (late, status) = shown(&[6]);
    let mut want = clean.clone();
    let frame = |slot: usize| clean[slot].2;
    (want[5], want[6]) = ((5, LightKind::Repeated, None), (6, LightKind::Lit, frame(5)));
    assert_eq!(late, want);
    assert_eq!((status.slots_repeated, status.frames_superseded), (1, 1));
    assert_eq!(status.frames_lit, all.frames_lit - 1);
    // Twice in a row: the same frame is late by two.
    let (late, status) = shown(&[6, 7]);
    let kinds: Vec<_> = late[5..8].iter().map(|(_, kind, frame)| (*kind, *frame)).collect();
    assert_eq!(kinds, [(LightKind::Repeated, None), (LightKind::Repeated, None), (LightKind::Lit, frame(5))]);
    assert_eq!((status.slots_repeated, status.frames_superseded), (2, 2));
}

/// STATUS says nothing of a frame until the panel has taken it: a host never learns what was not.
#[test]
fn no_report_names_a_frame_that_the_panel_has_not_taken() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    for id in 0..6u64 {
        rig.step(id);
    }
    let device = rig.cable.device_mut();
    let now = HostTime(rig.link.settings().rate.slot_start_ns(rig.slot));
    device.replies(now, &mut |_, _| {});
    let next = HostTime(rig.link.settings().rate.slot_start_ns(rig.slot + 1));
    device.advance_to(next);
    device.panel_busy(true);
    assert!(device.is_unsettled());
    device.replies(next, &mut |_, bytes| panic!("{} bytes were told", bytes.len()));
    device.panel_busy(false);
    let mut told = 0;
    device.replies(next, &mut |_, _| told += 1);
    assert_eq!(told, 1);
}

/// The clock may be bent while frames are lit: no slot is lost or told twice, and each begins where the new clock says.
#[test]
fn a_corrected_clock_moves_the_slots_and_loses_none() {
    let mut mock = ProjectorFirmware::new(FirmwareConfig::new(raster()));
    let before = mock.clock();
    let now = HostTime(3_000_000);
    let reading = before.ticks_at(now);
    let bent = DeviceClock { skew_ppb: 500_000, start_ticks: reading.0, power_on_at: now, ..before };
    mock.discipline(now, bent);
    assert_eq!(mock.clock().ticks_at(now), reading, "continuous");
    let later = now.plus_ns(2_000_000);
    assert_eq!(mock.clock().ticks_at(later).0 - reading.0, 2_001_000);
}
