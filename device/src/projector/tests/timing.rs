//! How early frames are whole, as STATUS reports it.

use super::*;
use crate::link::{Commit, FrameTiming, HostMessage};

fn timing(rig: &Rig<Direct<ProjectorFirmware>>) -> Option<FrameTiming> {
    rig.link.status().and_then(|status| status.timing)
}

/// A frame for slot `slot` is sent at `at`, and STATUS is read.
fn sent(rig: &mut Rig<Direct<ProjectorFirmware>>, id: u64, slot: u64, at: HostTime) -> SendOutcome {
    rig.now = at;
    rig.poll().expect("poll");
    let (target, dark_from) = rig.times(slot);
    let sent = rig.link.send_frame(at, id, target, dark_from, &planes(id), &mut rig.cable);
    rig.poll().expect("poll");
    sent
}

/// Slack is the time from the whole frame to its slot, to the tick, whether the frame is early or late, lit or dropped.
#[test]
fn status_reports_how_early_a_frame_was_whole() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    assert!(rig.link.measures_timing());
    let mut slot = rig.slot + 5;
    let mut id = 100;
    for slack_ns in [2_000_000, 1_000_000, 250_000, 1, 0, -1, -300_000, -900_000] {
        slot += 6;
        id += 1;
        let begin = rig.link.settings().rate.slot_start_ns(slot);
        assert_eq!(sent(&mut rig, id, slot, HostTime(begin - slack_ns)), SendOutcome::Sent);
        let told = timing(&rig).expect("it was asked for");
        assert_eq!((told.frame, i64::from(told.slack_ns)), (id as u32, slack_ns));
        let late = rig.cable.device().status().frames_late;
        assert_eq!(
            late > 0,
            slack_ns <= 0,
            "{slack_ns} ns: a frame that is late for its slot is dropped, and its slack is told"
        );
    }
}

/// The transfer lasts from a frame's first packet to the instant at which it is whole.
#[test]
fn status_reports_how_long_a_frame_took_to_arrive() {
    let mut rig = clean(settings(), FirmwareConfig::new(raster()));
    rig.stream();
    let slots = rig.link.slots().unwrap();
    let slot = rig.slot + 9;
    let mut payload = [0; crate::link::MAX_CONTROL_BYTES];
    let session = rig.cable.device().core.session;
    let header =
        Header { frame: 7, target_at: slots.start(slot), ..Header::control(MessageType::Plane, session, 0) };
    let (bytes, n) = (planes(7), raster().plane_bytes());
    let begun = rig.now.plus_ns(1_000);
    let schedule = PlaneSchedule::rgb24();
    for (k, spec) in schedule.planes().iter().enumerate() {
        let header = Header { plane: k as u8, led_code: spec.led_code(), ..header };
        let packet = Packet::new(header, &bytes[k * n..(k + 1) * n]).to_vec();
        rig.cable.device_mut().receive(begun.plus_ns(10_000 * k as i64), Lane::Data, &packet);
    }
    let commit = HostMessage::Commit(Commit {
        sent: (1 << 24) - 1,
        kept: 0,
        base_frame: 0,
        frames_sent: 1,
        dark_from: DeviceTicks(u64::MAX),
    });
    let (kind, len) = commit.write(&mut payload);
    let packet = Packet::new(Header { kind, ..header }, &payload[..len]).to_vec();
    rig.cable.device_mut().receive(begun.plus_ns(400_000), Lane::Data, &packet);
    let told = rig.cable.device().status().timing.expect("it was asked for");
    assert_eq!((told.frame, told.transfer_ns), (7, 400_000));
}

/// Firmware that does not measure lights as before: the host does not ask, and STATUS has its old length.
#[test]
fn firmware_that_does_not_measure_still_works() {
    let old = FirmwareConfig { measures_timing: false, firmware: 0x0100, ..FirmwareConfig::new(raster()) };
    let mut rig = clean(settings(), old);
    rig.stream();
    for id in 100..140 {
        assert_eq!(rig.step(id), SendOutcome::Sent);
    }
    assert!(!rig.link.measures_timing() && timing(&rig).is_none());
    assert!(rig.cable.device().status().frames_lit > 30);
    rig.cable.device().check_laws();
}
