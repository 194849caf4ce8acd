//! Packets that are damaged, foreign, cut short or no packets at all: skipped, counted, and the next one found.

use super::driver::{ConformanceDriver, MediumKind, R};
use super::shot::{damaged_payload, other_header};
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{
    DeviceMessage, DeviceState, Header, HostMessage, MessageType, Packet, Status, MAX_CONTROL_BYTES,
};
use dpm_device::transport::Lane;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "header-damaged",
        section: "2",
        statement: "a packet whose header CRC is wrong has no effect and is counted; the next one is found",
        check: header_damaged,
    },
    Rule {
        id: "payload-damaged",
        section: "2",
        statement: "a control message whose payload CRC is wrong has no effect and is counted",
        check: payload_damaged,
    },
    Rule {
        id: "version-foreign",
        section: "2",
        statement: "a packet of another version is stepped over by its length",
        check: version_foreign,
    },
    Rule {
        id: "type-unknown",
        section: "2",
        statement: "a packet of an unknown type is stepped over by its length",
        check: type_unknown,
    },
    Rule {
        id: "flags-unknown",
        section: "2",
        statement: "a packet of unknown flags is stepped over by its length",
        check: flags_unknown,
    },
    Rule {
        id: "direction",
        section: "4",
        statement: "messages that only devices send are ignored and counted",
        check: direction,
    },
    Rule {
        id: "noise",
        section: "2",
        statement: "bytes outside packets are skipped and counted, and the next packet is found",
        check: noise,
    },
    Rule {
        id: "cut-short",
        section: "2",
        statement: "where the medium ends a transfer, a half-received packet is dropped",
        check: cut_short,
    },
    Rule {
        id: "packets-counted",
        section: "4",
        statement: "packets with a right header are counted",
        check: packets_counted,
    },
    Rule {
        id: "last-plane",
        section: "4",
        statement: "STATUS names the plane that arrived last intact",
        check: last_plane,
    },
    Rule {
        id: "status-commit",
        section: "4",
        statement: "STATUS follows every FRAME_COMMIT and SYNC",
        check: status_commit,
    },
    Rule {
        id: "status-slots",
        section: "4",
        statement: "STATUS comes with the slots while armed, several of them merged at most",
        check: status_slots,
    },
];

/// Sends `packets` on the control lane together with an ECHO that must be answered; the reports before and after.
fn answered(b: &mut ConformanceDriver<'_>, packets: &[Packet<'_>], what: &str) -> R<(Status, Status)> {
    let before = b.report()?;
    let stamp = 0x0bad_0000_0000_0000 | u64::from(b.now().0 as u32);
    let mut payload = [0u8; MAX_CONTROL_BYTES];
    let (kind, n) = b.echo(stamp).write(&mut payload);
    let echo = Packet::new(Header::control(kind, b.session, 0), &payload[..n]);
    b.forget()?;
    b.send_packets(Lane::Control, &[packets, &[echo]].concat())?;
    let limit = b.answer_ns();
    let answer = b.wait(limit, |h| match h.message {
        DeviceMessage::Echo(e) if e.host_sent_ns == stamp => Some(()),
        _ => None,
    })?;
    check(answer.is_some(), &format!("the ECHO that follows {what} answered"), || "no answer".into())?;
    let after = b.report()?;
    Ok((before, after))
}

/// An ARM in a configured device, which must not be obeyed.
fn arm_payload() -> ([u8; 4], Header) {
    ([0; 4], Header::control(MessageType::Arm, 0, 4))
}

fn header_damaged(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let (payload, header) = arm_payload();
    let header = Header { session: b.session, ..header };
    let right = Packet::new(header, &payload);
    let mut bytes = header.encode();
    bytes[29] ^= 0x40;
    let trailer = right.trailer().to_vec();
    let (before, after) = answered(b, &[Packet::from_raw(bytes, &payload, &trailer)], "a damaged header")?;
    check(after.state == DeviceState::Configured, "no effect of an ARM with a damaged header", || {
        tell(&after)
    })?;
    check(grew(&before, &after, |s| s.header_errors) == 1, "one damaged header counted", || tell(&after))
}

fn payload_damaged(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let (payload, header) = arm_payload();
    let header = Header { session: b.session, ..header };
    let (before, after) = answered(b, &[damaged_payload(&header, &payload)], "a damaged payload")?;
    check(after.state == DeviceState::Configured, "no effect of an ARM with a damaged payload", || {
        tell(&after)
    })?;
    check(grew(&before, &after, |s| s.payload_errors) == 1, "one damaged payload counted", || tell(&after))
}

/// An ARM that is right but for one byte of its header. What it acknowledges spells the beginning of a packet: nobody must look for one there.
fn foreign(b: &mut ConformanceDriver<'_>, at: usize, value: u8, what: &str) -> R {
    b.configured(|_| {})?;
    let payload = *b"DPML";
    let header = Header::control(MessageType::Arm, b.session, 4);
    let right = Packet::new(header, &payload);
    let trailer = right.trailer().to_vec();
    let bytes = other_header(&header, at, value);
    let (before, after) = answered(b, &[Packet::from_raw(bytes, &payload, &trailer)], what)?;
    check(after.state == DeviceState::Configured, &format!("no effect of {what}"), || tell(&after))?;
    let damaged = grew(&before, &after, |s| s.header_errors) + grew(&before, &after, |s| s.payload_errors);
    check(damaged == 0, &format!("{what} stepped over, not damaged"), || tell(&after))?;
    check(grew(&before, &after, |s| s.packets_ignored) == 1, &format!("{what} counted as ignored"), || {
        tell(&after)
    })
}

fn version_foreign(b: &mut ConformanceDriver<'_>) -> R {
    foreign(b, 4, 99, "a packet of version 99")
}

fn type_unknown(b: &mut ConformanceDriver<'_>) -> R {
    foreign(b, 5, 200, "a packet of type 200")
}

fn flags_unknown(b: &mut ConformanceDriver<'_>) -> R {
    foreign(b, 6, 0x40, "a packet of flags 0x40")
}

fn direction(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let status = [0u8; 96];
    let header = Header::control(MessageType::Status, b.session, 96);
    let before = b.report()?;
    b.send_packets(Lane::Control, &[Packet::new(header, &status)])?;
    let fault = [0u8; 16];
    let header = Header::control(MessageType::Fault, b.session, 16);
    b.send_packets(Lane::Control, &[Packet::new(header, &fault)])?;
    let after = b.report()?;
    check(after.state == DeviceState::Configured, "no effect", || tell(&after))?;
    check(grew(&before, &after, |s| s.packets_ignored) == 2, "2 packets counted as ignored", || tell(&after))
}

fn noise(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    // Bytes that begin like packets here and there.
    let mut header = [0x5au8; 32];
    header[9..12].copy_from_slice(b"DPM");
    let (before, after) = answered(b, &[Packet::from_raw(header, &[0x44; 12], &[])], "noise")?;
    let skipped = grew(&before, &after, |s| s.bytes_skipped);
    check(skipped == 44, "44 bytes outside packets counted", || skipped.to_string())?;
    check(after.state == DeviceState::Configured, "no effect", || tell(&after))
}

fn cut_short(b: &mut ConformanceDriver<'_>) -> R {
    if b.medium.kind == MediumKind::InProcess {
        return Err(Stop::NotJudged("nothing ends a transfer to a device in this process".into()));
    }
    b.configured(|_| {})?;
    let before = b.report()?;
    // A header that promises 96 bytes, and 20 of them.
    let header = Header::control(MessageType::Status, b.session, 96).encode();
    b.send_packets(Lane::Control, &[Packet::from_raw(header, &[0; 20], &[])])?;
    b.pass(20_000_000)?;
    let limit = b.answer_ns();
    for stamp in 1..=2u64 {
        b.forget()?;
        b.say(&b.echo(stamp))?;
        let answer = b.wait(limit, |h| match h.message {
            DeviceMessage::Echo(e) if e.host_sent_ns == stamp => Some(()),
            _ => None,
        })?;
        check(answer.is_some(), "the ECHO after a packet cut short answered", || "no answer".into())?;
    }
    let after = b.report()?;
    check(grew(&before, &after, |s| s.header_errors) == 0, "no damaged header", || tell(&after))
}

fn packets_counted(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let before = b.report()?;
    b.feed = false;
    for k in 0..5 {
        b.say(&b.echo(k))?;
    }
    b.say_as(b.session ^ 3, &b.echo(9))?;
    b.pass(30_000_000)?;
    b.feed = true;
    b.forget()?;
    b.say(&HostMessage::Sync(b.frames_sent))?;
    b.pass(60_000_000)?;
    let after = b.report()?;
    // Five, the stranger's, and two or three SYNCs; the driver may have fed the watchdog.
    let packets = grew(&before, &after, |s| s.packets);
    check((8..=12).contains(&packets), "8 to 12 packets counted", || packets.to_string())
}

fn last_plane(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    if b.plain_config()?.schedule.len() < 2 {
        return Err(Stop::NotJudged("its frames have one plane".into()));
    }
    for last in [1u8, 0] {
        let slot = b.slot_ahead()?;
        let mut shot = b.shot(slot)?;
        shot.pieces.sort_by_key(|p| p.plane != 1 - last);
        b.send(&shot)?;
        let s = b.report()?;
        check(s.last_plane == last, &format!("plane {last}"), || s.last_plane.to_string())?;
    }
    Ok(())
}

fn status_commit(b: &mut ConformanceDriver<'_>) -> R {
    // Slots so long that none of them asks for a STATUS.
    b.armed(|c| c.rate = dpm_device::time::FrameRate::new(1, 1).unwrap_or(c.rate))?;
    b.needs_frames()?;
    let now = b.report()?;
    let slot = b.slots()?.slot_at(now.now).map_or(1, |k| k + 1);
    b.until_slot(slot)?;
    b.feed = false;
    b.forget()?;
    let shot = b.send_for(slot + 1)?;
    let limit = b.answer_ns();
    let s = b.wait_status(limit, |s| s.last_whole_frame == shot.id)?;
    let s = s.ok_or_else(|| b.silent("STATUS after FRAME_COMMIT"))?;
    check(b.slots()?.slot_at(s.now) == Some(slot), "a STATUS of the same slot", || tell(&s))?;
    b.forget()?;
    b.say(&HostMessage::Sync(b.frames_sent))?;
    let s = b.wait_status(limit, |_| true)?;
    b.feed = true;
    check(s.is_some(), "STATUS after SYNC", || "none".into())
}

fn status_slots(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.report()?;
    b.pass(20_000_000)?;
    b.forget()?;
    let ms = u64::from(b.slot_ms());
    let begin = b.now();
    let (mut heard, mut slots) = (0u32, Vec::new());
    let session = b.session;
    let limit = (24 * ms * 1_000_000) as i64;
    let clock = b.slots()?;
    b.wait(limit, |h| {
        if let (DeviceMessage::Status(s), true) = (h.message, h.session == session) {
            heard += 1;
            slots.push(clock.slot_at(s.now).unwrap_or(0));
        }
        None::<()>
    })?;
    slots.dedup();
    let took = b.now().ns_since(begin) / 1_000_000;
    check(slots.len() >= 6, &format!("reports from 6 slots at least of the 24 within {took} ms"), || {
        format!("{heard} reports from {} slots", slots.len())
    })
}
