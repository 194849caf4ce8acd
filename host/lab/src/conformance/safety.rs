//! What a device does against damage, flashes and too much light, whatever its host says; and a host that goes and comes back.

use super::driver::{ConformanceDriver, R};
use super::orders::lit_frame;
use super::shot::damaged_payload;
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{
    faults, Config, DeviceMessage, DeviceState, FaultCode, Header, HostMessage, LightLimits, MessageType,
    Status, MAX_CONTROL_BYTES,
};
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec};
use dpm_device::time::FrameRate;
use dpm_device::transport::Lane;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "checksum-storm",
        section: "6",
        statement: "1000 damaged packets without a whole frame latch fault 4",
        check: checksum_storm,
    },
    Rule {
        id: "limits-format",
        section: "4",
        statement: "limits out of range are refused: FAULT 2, detail 4 (or 5 where light is not counted)",
        check: limits_format,
    },
    Rule {
        id: "limit-mean",
        section: "6",
        statement:
            "the mean level over the window is never exceeded: fault 7, and ARM refused while light rests",
        check: limit_mean,
    },
    Rule {
        id: "limit-white",
        section: "6",
        statement: "full white never lasts longer than CONFIG allows: fault 7",
        check: limit_white,
    },
    Rule {
        id: "flashes",
        section: "6",
        statement:
            "a field that flashes 12 times a second latches fault 6, and ARM is refused while light rests",
        check: flashes,
    },
    Rule {
        id: "replug",
        section: "6",
        statement: "opened again, it takes a new session and is lit within a second",
        check: replug,
    },
    Rule {
        id: "session-old",
        section: "6",
        statement: "packets of the session before have no effect",
        check: session_old,
    },
];

fn checksum_storm(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let header = Header::control(MessageType::Echo, b.session, 4);
    let one = || damaged_payload(&header, &[7; 4]);
    if b.carry_ns(1100 * 42) > 8_000_000_000 {
        return Err(Stop::NotJudged("1000 packets take this medium longer than 8 s".into()));
    }
    let before = b.report()?;
    let mut sent = 0u32;
    while sent < 960 {
        b.send_packets(Lane::Control, &[one(), one(), one()])?;
        sent += 3;
        if sent.is_multiple_of(60) {
            // Intact packets, which are no whole frames, change nothing.
            b.report()?;
        }
    }
    let s = b.report()?;
    check(s.faults == 0 && grew(&before, &s, |s| s.payload_errors) == 960, "no fault after 960", || {
        tell(&s)
    })?;
    for _ in 0..15 {
        b.send_packets(Lane::Control, &[one(), one(), one()])?;
    }
    let s = b.report()?;
    check(
        s.state == DeviceState::Faulted && s.faults & faults::CHECKSUM_STORM != 0,
        "fault 4 latched after 1005",
        || tell(&s),
    )
}

/// A CONFIG with limits; `false` where the device refuses to count light.
fn with_limits(
    b: &mut ConformanceDriver<'_>,
    limits: LightLimits,
    change: impl FnOnce(&mut Config),
) -> R<bool> {
    b.open()?;
    let mut config = b.plain_config()?;
    config.limits = limits;
    change(&mut config);
    b.forget()?;
    b.say(&HostMessage::Config(config))?;
    let limit = b.answer_ns();
    let session = b.session;
    let answer = b.wait(limit, |h| match h.message {
        DeviceMessage::Fault(f) if f.code == FaultCode::Config => Some(Some(f.detail)),
        DeviceMessage::Status(s)
            if h.session == session && matches!(s.state, DeviceState::Configured | DeviceState::Faulted) =>
        {
            Some(None)
        }
        _ => None,
    })?;
    match answer {
        Some(Some(5)) => Ok(false),
        Some(Some(detail)) => {
            Err(Stop::Failed(format!("limits within their range refused, detail {detail}")))
        }
        Some(None) => {
            // The driver's books of this configuration.
            b.configure(&config)?;
            b.arm()?;
            Ok(true)
        }
        None => Err(b.silent("STATUS or FAULT 2 after CONFIG with limits")),
    }
}

fn limits_format(b: &mut ConformanceDriver<'_>) -> R {
    let cases: [(&str, usize, &[u8]); 4] = [
        ("a mean of 1001 thousandths", 20, &1001u16.to_le_bytes()),
        ("a window of 499 ms", 32, &499u32.to_le_bytes()),
        ("a window of more than an hour", 32, &3_600_001u32.to_le_bytes()),
        ("full white of 499 ms", 36, &499u32.to_le_bytes()),
    ];
    for (what, at, bytes) in cases {
        b.open()?;
        let mut config = b.plain_config()?;
        config.limits = LightLimits { mean_permille: 500, window_ms: 1000, full_white_ms: 1000 };
        let mut payload = [0u8; MAX_CONTROL_BYTES];
        let (kind, n) = HostMessage::Config(config).write(&mut payload);
        payload[at..at + bytes.len()].copy_from_slice(bytes);
        b.forget()?;
        b.say_raw(kind, &payload[..n])?;
        let limit = b.answer_ns();
        let fault = b.wait_fault(limit, FaultCode::Config)?;
        let Some(fault) = fault else {
            return Err(Stop::Failed(format!("{what}: expected FAULT 2, saw none")));
        };
        check(matches!(fault.detail, 4 | 5), &format!("{what}: detail 4 or 5"), || fault.detail.to_string())?;
    }
    Ok(())
}

/// A frame of `code` in every mirror of the first plane, for `slot`.
fn full(b: &mut ConformanceDriver<'_>, slot: u64) -> R {
    let mut shot = b.shot(slot)?;
    let raster = b.hello.map(|h| h.raster).ok_or(Stop::Failed("no HELLO".into()))?;
    let mut row = vec![0xffu8; raster.row_bytes()];
    let padding = row.len() as u32 * 8 - raster.width();
    if let Some(last) = row.last_mut() {
        *last <<= padding;
    }
    let plane = row.repeat(raster.height() as usize);
    let (codec, bytes) = b.coded(&plane);
    for piece in &mut shot.pieces {
        (piece.codec, piece.bytes) = (codec, bytes.clone());
    }
    b.send(&shot)
}

/// Frames of full planes take the medium no longer than a few slots.
fn needs_full(b: &mut ConformanceDriver<'_>) -> R {
    let hello = b.open()?;
    let plane = vec![0xff; hello.raster.plane_bytes()];
    let bytes = if hello.raster.width() % 8 == 0 { b.coded(&plane).1.len() } else { plane.len() };
    if b.carry_ns(8 * bytes) > 400_000_000 {
        return Err(Stop::NotJudged("full planes take this medium too long".into()));
    }
    Ok(())
}

/// Waits for `fault`, then for ARM to be refused because light rests. The time from `began` to the fault, ms.
fn rests(b: &mut ConformanceDriver<'_>, fault: u32, began: u64, within_ms: u64) -> R<u64> {
    let limit = (within_ms as i64) * 1_000_000 + b.answer_ns();
    let session = b.session;
    // It may have come while frames were still sent.
    let already = b.report()?;
    let mut at = (already.faults & fault != 0).then_some(already.now.0);
    let limit = if at.is_some() { 0 } else { limit };
    b.wait(limit, |h| match h.message {
        DeviceMessage::Fault(f) if f.latched & fault != 0 => {
            at = Some(f.at.0);
            Some(())
        }
        DeviceMessage::Status(s) if h.session == session && s.faults & fault != 0 => {
            at = at.or(Some(s.now.0));
            Some(())
        }
        _ => None,
    })?;
    let at = at.ok_or_else(|| {
        Stop::Failed(format!("expected fault {} latched, saw {}", fault.trailing_zeros(), b.newest()))
    })?;
    let s = b.report()?;
    check(s.state == DeviceState::Faulted && !s.lit, "faulted and dark", || tell(&s))?;
    b.forget()?;
    b.say(&HostMessage::Arm(u32::MAX))?;
    let limit = b.answer_ns();
    let refused =
        b.wait_fault(limit, FaultCode::Arm)?.ok_or_else(|| b.silent("FAULT 3 while light rests"))?;
    check(refused.detail == 3, "detail 3: light rests", || refused.detail.to_string())?;
    Ok(at.saturating_sub(began) * 1000 / b.tick_hz().max(1))
}

/// One plane of the highest bit, so that full planes are half of full light.
fn half_light(c: &mut Config) {
    let half = [PlaneSpec { channel: Channel::Red, bit: 7 }];
    c.schedule = PlaneSchedule::new(&half).unwrap_or(c.schedule);
}

fn not_counted() -> Stop {
    Stop::NotJudged("it does not count light (FAULT 2, detail 5)".into())
}

fn limit_mean(b: &mut ConformanceDriver<'_>) -> R {
    needs_full(b)?;
    // 128 of 255 in one channel, against a tenth over half a second: after a fifth of the window.
    let limits = LightLimits { mean_permille: 100, window_ms: 500, full_white_ms: 0 };
    if !with_limits(b, limits, half_light)? {
        return Err(not_counted());
    }
    let slot = b.slot_ahead()?;
    full(b, slot)?;
    let began = b.slots()?.start(slot).0;
    let slots_lit = |s: &Status| s.frames_lit + s.slots_repeated;
    let ms = rests(b, faults::LIGHT_LIMIT, began, 1000)?;
    let s = b.report()?;
    let slot_ms = u64::from(b.slot_ms());
    let most = 500 * 255 / (10 * 128);
    check(
        ms <= most + slot_ms && u64::from(slots_lit(&s)) * slot_ms <= most + slot_ms,
        &format!("light for {most} ms at most"),
        || format!("{ms} ms, {}", tell(&s)),
    )?;
    check(
        u64::from(slots_lit(&s)) * slot_ms + 2 * slot_ms >= most.saturating_sub(2 * slot_ms),
        "not before the limit",
        || tell(&s),
    )
}

fn white_planes(c: &mut Config, most: u8) -> bool {
    let all: Vec<PlaneSpec> =
        (0..8u8).map(|bit| PlaneSpec { channel: Channel::White, bit: 7 - bit }).collect();
    match PlaneSchedule::new(&all) {
        Some(schedule) if most >= 8 => {
            c.schedule = schedule;
            true
        }
        _ => false,
    }
}

fn limit_white(b: &mut ConformanceDriver<'_>) -> R {
    needs_full(b)?;
    let hello = b.open()?;
    if hello.max_planes < 8 {
        return Err(Stop::NotJudged("eight planes make full white, and it takes fewer".into()));
    }
    let limits = LightLimits { mean_permille: 0, window_ms: 0, full_white_ms: 500 };
    let counted = with_limits(b, limits, |c| {
        white_planes(c, hello.max_planes);
    })?;
    if !counted {
        return Err(not_counted());
    }
    let slot = b.slot_ahead()?;
    full(b, slot)?;
    let began = b.slots()?.start(slot).0;
    let ms = rests(b, faults::LIGHT_LIMIT, began, 1500)?;
    let slot_ms = u64::from(b.slot_ms());
    check(
        (500 - 2 * slot_ms.min(200)..=500 + slot_ms + 5).contains(&ms),
        "fault 7 after 500 ms of full white",
        || format!("{ms} ms"),
    )
}

fn flashes(b: &mut ConformanceDriver<'_>) -> R {
    if !b.may_flash {
        return Err(Stop::NotJudged(
            "the light would flash for a second, which can cause seizures; --flashes allows it".into(),
        ));
    }
    needs_full(b)?;
    let hello = b.open()?;
    if hello.max_planes < 8 || b.slot_ms() > 35 {
        return Err(Stop::NotJudged("its planes or this medium are too slow to flash".into()));
    }
    b.armed(|c| {
        white_planes(c, hello.max_planes);
        c.underrun = dpm_device::link::Underrun::Blank;
        c.rate = FrameRate::new(1000, 40).unwrap_or(c.rate);
    })?;
    // Every second slot of 40 ms: 12.5 flashes a second. Far more than 8 changes a second; a device may take a second to see them.
    let mut slot = b.slot_ahead()?;
    let began = b.slots()?.start(slot).0;
    for _ in 0..14 {
        full(b, slot)?;
        slot += 2;
        // Two frames ahead at most.
        let ahead = b.slots()?.start(slot.saturating_sub(3)).0;
        if b.until(ahead)?.faults != 0 {
            break;
        }
    }
    rests(b, faults::FLASH_LIMIT, began, 500)?;
    Ok(())
}

fn replug(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    lit_frame(b)?;
    if b.medium.kind == super::MediumKind::InProcess {
        return Err(Stop::NotJudged("a device in this process has no plug".into()));
    }
    let mut opened = Err(Stop::Failed("the medium could not be opened again within 2 s".into()));
    let end = b.now().plus_ns(2_000_000_000);
    while opened.is_err() && b.now() < end {
        match b.medium.transport.reopen() {
            Ok(()) => opened = Ok(()),
            Err(_) => std::thread::sleep(std::time::Duration::from_millis(20)),
        }
    }
    opened?;
    let begin = b.now();
    b.armed(|_| {})?;
    lit_frame(b)?;
    let ms = b.now().ns_since(begin) / 1_000_000;
    // The driver's own patience with a slow medium comes on top.
    let slack = b.carry_ns(6000) / 1_000_000;
    check(ms <= 1000 + slack, "light within a second", || format!("{ms} ms"))
}

fn session_old(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let old = b.session;
    b.configured(|_| {})?;
    let before = b.report()?;
    b.say_as(old, &HostMessage::Arm(0))?;
    let after = b.report()?;
    check(
        after.state == DeviceState::Configured || after.faults != 0,
        "not armed by the session before",
        || tell(&after),
    )?;
    check(grew(&before, &after, |s| s.packets_ignored) == 1, "the packet counted as ignored", || tell(&after))
}
