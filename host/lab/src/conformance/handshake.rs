//! HELLO and CONFIG: who is there, what it can do, and what it must refuse.

use super::driver::{ConformanceDriver, R};
use super::orders::lit_frame;
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{DeviceMessage, DeviceState, FaultCode, HostHello, HostMessage, MessageType, VERSION};

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "no-session",
        section: "4",
        statement: "without a session any packet is answered by a STATUS of session 0",
        check: no_session,
    },
    Rule {
        id: "hello-answer",
        section: "4",
        statement: "HELLO is answered by a HELLO of the same session that says what the device is",
        check: hello_answer,
    },
    Rule {
        id: "hello-version",
        section: "4",
        statement: "a HELLO without the device's version opens no session; FAULT 1 names the version",
        check: hello_version,
    },
    Rule { id: "hello-zero", section: "2", statement: "session 0 cannot be opened", check: hello_zero },
    Rule {
        id: "hello-same",
        section: "6",
        statement: "HELLO of the open session is only answered: state, counters and frames go on",
        check: hello_same,
    },
    Rule {
        id: "hello-new",
        section: "6",
        statement: "HELLO of a new session ends the old one and its light, and all counters begin at 0",
        check: hello_new,
    },
    Rule {
        id: "session-other",
        section: "2",
        statement: "packets of another session have no effect and are counted as ignored",
        check: session_other,
    },
    Rule {
        id: "config-accepted",
        section: "4",
        statement: "a CONFIG within what HELLO says leads to configured: dark, without credit",
        check: config_accepted,
    },
    Rule {
        id: "config-raster",
        section: "4",
        statement: "another raster is refused: FAULT 2, detail 1",
        check: config_raster,
    },
    Rule {
        id: "config-planes",
        section: "4",
        statement: "more planes than HELLO says are refused: FAULT 2, detail 2",
        check: config_planes,
    },
    Rule {
        id: "config-rate",
        section: "4",
        statement: "planes shorter than HELLO says are refused: FAULT 2, detail 3",
        check: config_rate,
    },
    Rule {
        id: "config-format",
        section: "4",
        statement: "fields out of range are refused: FAULT 2, detail 4",
        check: config_format,
    },
    Rule { id: "config-disarms", section: "4", statement: "CONFIG disarms", check: config_disarms },
    Rule {
        id: "payload-length",
        section: "4",
        statement: "a payload of another length has no effect and is counted as ignored",
        check: payload_length,
    },
    Rule {
        id: "padding-ignored",
        section: "2",
        statement: "the padding after a payload is not looked at",
        check: padding_ignored,
    },
];

fn no_session(b: &mut ConformanceDriver<'_>) -> R {
    if b.hello.is_some() {
        return Err(Stop::NotJudged("a session was opened before".into()));
    }
    b.forget()?;
    b.say_as(0x5eed_0001, &b.echo(1))?;
    let limit = b.answer_ns();
    let answer = b.wait(limit, |h| match h.message {
        DeviceMessage::Status(s) => Some((h.session, s)),
        _ => None,
    })?;
    match answer {
        Some((0, s)) => check(
            s.state == DeviceState::Idle || s.faults != 0,
            "state 0 (idle) in a STATUS of session 0",
            || tell(&s),
        ),
        // A host was here since it was switched on.
        Some((other, _)) => Err(Stop::NotJudged(format!("session {other:#x} of an earlier host is open"))),
        None => Err(Stop::NotJudged(
            "no answer: an earlier host's session is open, or the device is silent (see hello-answer)".into(),
        )),
    }
}

fn hello_answer(b: &mut ConformanceDriver<'_>) -> R {
    let h = b.open()?;
    check(h.version == u16::from(VERSION), "version 2", || h.version.to_string())?;
    check((1..=32).contains(&h.max_planes), "1 to 32 planes", || h.max_planes.to_string())?;
    check(h.frame_buffers >= 1, "one frame buffer at least", || "none".into())?;
    check(h.tick_hz >= 1000, "a clock of 1000 ticks/s at least", || h.tick_hz.to_string())?;
    check(h.codecs & 1 == 1, "codec 0 (raw), which is mandatory", || format!("codecs {:#x}", h.codecs))?;
    let s = b.report()?;
    check(s.state == DeviceState::Greeted || s.faults != 0, "state 1 (greeted)", || tell(&s))?;
    check(!s.lit, "no light", || tell(&s))?;
    // The same device says the same twice.
    let again = b.open()?;
    check(
        (again.raster, again.serial, again.codecs) == (h.raster, h.serial, h.codecs),
        "the same device",
        || format!("{again:?} after {h:?}"),
    )
}

fn hello_version(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    let open = b.session;
    let other = open ^ 0x0f0f_0f0f;
    b.forget()?;
    b.say_as(other, &HostMessage::Hello(HostHello { version_min: 200, version_max: 300, codecs: 1 }))?;
    let limit = b.answer_ns();
    let fault = b.wait_fault(limit, FaultCode::Version)?.ok_or_else(|| b.silent("FAULT 1"))?;
    check(fault.detail == u16::from(VERSION), "the device's version as detail", || fault.detail.to_string())?;
    b.forget()?;
    b.say_as(other, &b.echo(77))?;
    let answered = b.wait(limit / 2, |h| match h.message {
        DeviceMessage::Echo(e) if e.host_sent_ns == 77 => Some(()),
        _ => None,
    })?;
    check(answered.is_none(), "no session of that number", || "its ECHO answered".into())
}

fn hello_zero(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    b.forget()?;
    b.say_as(0, &HostMessage::Hello(HostHello { version_min: 0, version_max: 9, codecs: 1 }))?;
    let limit = b.answer_ns() / 2;
    let answer = b.wait(limit, |h| match h.message {
        DeviceMessage::Hello(_) if h.session == 0 => Some(()),
        _ => None,
    })?;
    check(answer.is_none(), "no answer to HELLO of session 0", || "a HELLO".into())?;
    let s = b.report()?;
    check(s.state == DeviceState::Greeted || s.faults != 0, "the session that was open to go on", || tell(&s))
}

fn hello_same(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let before = lit_frame(b)?;
    b.forget()?;
    b.say(&HostMessage::Hello(HostHello {
        version_min: u16::from(VERSION),
        version_max: u16::from(VERSION),
        codecs: 0xf,
    }))?;
    let limit = b.answer_ns();
    let session = b.session;
    let answer = b.wait(limit, |h| match h.message {
        DeviceMessage::Hello(_) if h.session == session => Some(()),
        _ => None,
    })?;
    check(answer.is_some(), "an answer to HELLO of the open session", || "none".into())?;
    let after = b.report()?;
    check(after.state == DeviceState::Armed && after.lit, "armed, with light", || tell(&after))?;
    check(
        after.frames_lit == before.frames_lit && after.slots >= before.slots && before.frames_lit == 1,
        "counters that go on",
        || format!("{} after {}", tell(&after), tell(&before)),
    )
}

fn hello_new(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let lit = lit_frame(b)?;
    check(lit.frames_lit == 1, "one frame lit", || tell(&lit))?;
    // Something damaged and something ignored, so that no counter is 0.
    b.say_as(b.session ^ 1, &b.echo(0))?;
    b.report()?;
    b.open()?;
    let s = b.report()?;
    check(s.state == DeviceState::Greeted && !s.lit, "greeted and dark", || tell(&s))?;
    let counters =
        [s.slots, s.frames_seen, s.frames_lit, s.frames_accounted, s.frames_refused, s.packets_ignored];
    check(counters == [0; 6], "counters at 0", || tell(&s))?;
    // HELLO, and SYNC; where STATUS was asked for again, more of them.
    check(s.packets <= 8, "packets counted from the HELLO on", || format!("{} packets", s.packets))
}

fn session_other(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let before = b.report()?;
    let other = b.session.wrapping_add(1).max(1);
    b.say_as(other, &HostMessage::Arm(0))?;
    b.say_as(other, &b.echo(4711))?;
    let after = b.report()?;
    check(
        after.state == DeviceState::Configured,
        "configured: ARM of another session has no effect",
        || tell(&after),
    )?;
    let ignored = grew(&before, &after, |s| s.packets_ignored);
    check(ignored == 2, "2 packets more counted as ignored", || ignored.to_string())
}

fn config_accepted(b: &mut ConformanceDriver<'_>) -> R {
    let s = b.configured(|_| {})?;
    check(s.state == DeviceState::Configured || s.faults != 0, "state 2 (configured)", || tell(&s))?;
    check(!s.lit && s.frame_limit == s.frames_accounted, "dark, without credit", || tell(&s))
}

/// A CONFIG that must be refused with `detail`, and leave the device as it was.
fn refused(b: &mut ConformanceDriver<'_>, config: &[u8], details: &[u16], what: &str) -> R {
    b.forget()?;
    b.say_raw(MessageType::Config, config)?;
    let limit = b.answer_ns();
    let fault = b.wait_fault(limit, FaultCode::Config)?;
    let Some(fault) = fault else {
        return Err(Stop::Failed(format!("{what}: expected FAULT 2, saw none; {}", b.newest())));
    };
    check(details.contains(&fault.detail), &format!("{what}: FAULT 2, detail {details:?}"), || {
        format!("detail {}", fault.detail)
    })?;
    let s = b.report()?;
    check(s.state == DeviceState::Greeted || s.faults != 0, &format!("{what}: not configured"), || tell(&s))
}

/// The plain CONFIG's payload.
fn plain(b: &mut ConformanceDriver<'_>) -> R<Vec<u8>> {
    b.open()?;
    let config = b.plain_config()?;
    let mut out = [0u8; dpm_device::link::MAX_CONTROL_BYTES];
    let (_, n) = HostMessage::Config(config).write(&mut out);
    Ok(out[..n].to_vec())
}

fn config_raster(b: &mut ConformanceDriver<'_>) -> R {
    for at in [0, 2] {
        let mut p = plain(b)?;
        let side = u16::from_le_bytes([p[at], p[at + 1]]);
        let other = if side == 1 { 2 } else { side - 1 };
        p[at..at + 2].copy_from_slice(&other.to_le_bytes());
        refused(b, &p, &[1], if at == 0 { "a width less by one" } else { "a height less by one" })?;
    }
    Ok(())
}

fn config_planes(b: &mut ConformanceDriver<'_>) -> R {
    let mut p = plain(b)?;
    let most = b.hello.map_or(32, |h| h.max_planes);
    if most >= 32 {
        return Err(Stop::NotJudged("it takes as many planes as CONFIG can name".into()));
    }
    p[16] = most + 1;
    p.truncate(40);
    p.extend((0..=most).map(|k| ((k / 8) << 4) | (k % 8)));
    // So slow that the rate is no reason.
    p[4..12].copy_from_slice(&[1, 0, 0, 0, 1, 0, 0, 0]);
    refused(b, &p, &[2], "one plane more than it takes")
}

fn config_rate(b: &mut ConformanceDriver<'_>) -> R {
    let mut p = plain(b)?;
    let shortest = b.hello.map_or(0, |h| h.min_plane_ns);
    let planes = u64::from(p[16]);
    if shortest < 2 {
        return Err(Stop::NotJudged("it names no shortest time of a plane".into()));
    }
    // 3/4 of the shortest time for each plane: frames/s as 4 * 10^9 / (3 * shortest * planes).
    let den = u64::from(shortest) * planes * 3;
    let Ok(den) = u32::try_from(den) else { return Err(Stop::NotJudged("its planes last a second".into())) };
    p[4..8].copy_from_slice(&4_000_000_000u32.to_le_bytes());
    p[8..12].copy_from_slice(&den.to_le_bytes());
    refused(b, &p, &[3], "planes of 3/4 of the shortest time")
}

fn config_format(b: &mut ConformanceDriver<'_>) -> R {
    let set = |p: &mut Vec<u8>, at: usize, bytes: &[u8]| p[at..at + bytes.len()].copy_from_slice(bytes);
    type Break<'x> = (&'x str, &'x dyn Fn(&mut Vec<u8>));
    let cases: [Break<'_>; 6] = [
        ("a watchdog of 0", &|p| set(p, 12, &[0; 4])),
        ("a watchdog of more than 10 s", &|p| set(p, 12, &10_000_001u32.to_le_bytes())),
        ("a frame rate of 0", &|p| set(p, 4, &[0; 4])),
        ("a frame rate over 0", &|p| set(p, 8, &[0; 4])),
        ("something else than repeat and blank", &|p| set(p, 17, &[2])),
        ("an LED code that no plane has", &|p| set(p, 40, &[0x08])),
    ];
    for (what, change) in cases {
        let mut p = plain(b)?;
        change(&mut p);
        refused(b, &p, &[4], what)?;
    }
    let mut p = plain(b)?;
    if p[16] >= 2 {
        p[41] = p[40];
        refused(b, &p, &[4], "an LED code that stands twice")?;
    }
    if b.hello.is_some_and(|hello| !hello.exceeds) {
        let mut p = plain(b)?;
        // Three planes of bit 7, which is more than full light.
        p.truncate(40);
        (p[16], p[19]) = (3, p[19] | 33);
        p.extend([0x07; 3]);
        refused(b, &p, &[2, 4], "planes that exceed full light, which it does not offer")?;
    }
    Ok(())
}

fn config_disarms(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    lit_frame(b)?;
    let config = b.plain_config()?;
    let s = b.configure(&config)?;
    check(s.state == DeviceState::Configured && !s.lit, "configured and dark", || tell(&s))
}

fn payload_length(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let before = b.report()?;
    b.say_raw(MessageType::Arm, &[0; 8])?;
    b.say_raw(MessageType::Arm, &[0; 3])?;
    b.say_raw(MessageType::Freeze, &[0; 4])?;
    b.say_raw(MessageType::Echo, &[0; 20])?;
    let after = b.report()?;
    check(after.state == DeviceState::Configured, "configured: an ARM of 8 bytes has no effect", || {
        tell(&after)
    })?;
    let ignored = grew(&before, &after, |s| s.packets_ignored);
    check(ignored == 4, "4 packets more counted as ignored", || ignored.to_string())
}

fn padding_ignored(b: &mut ConformanceDriver<'_>) -> R {
    use dpm_device::link::{crc32c, Header, Packet};
    let p = plain(b)?;
    let pad = (4 - p.len() % 4) % 4;
    if pad == 0 {
        return Err(Stop::NotJudged("no message of the rule needs padding".into()));
    }
    let header = Header::control(MessageType::Config, b.session, p.len() as u32);
    let mut trailer = vec![0xa5; pad];
    trailer.extend(crc32c(&p).to_le_bytes());
    b.forget()?;
    b.send_packets(dpm_device::transport::Lane::Control, &[Packet::from_raw(header.encode(), &p, &trailer)])?;
    let s = b.report()?;
    check(
        s.state == DeviceState::Configured || s.faults != 0 && s.payload_errors == 0,
        "configured by a CONFIG whose padding is not 0",
        || tell(&s),
    )
}
