//! ARM and the four verbs: permission to make light, and its end.

use super::driver::{ConformanceDriver, R};
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{faults, Config, DeviceState, FaultCode, HostMessage, Status};
use dpm_device::time::FrameRate;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "arm-unconfigured",
        section: "4",
        statement: "ARM before CONFIG is refused: FAULT 3, detail 1",
        check: arm_unconfigured,
    },
    Rule {
        id: "arm",
        section: "6",
        statement: "ARM leads from configured to armed, dark until a frame is due",
        check: arm,
    },
    Rule { id: "arm-twice", section: "6", statement: "ARM is safe to receive twice", check: arm_twice },
    Rule {
        id: "arm-faults",
        section: "6",
        statement: "with latched faults ARM must name every one; else FAULT 3, detail 2",
        check: arm_faults,
    },
    Rule {
        id: "stop",
        section: "6",
        statement: "STOP disarms and darkens at once, within the slot",
        check: stop,
    },
    Rule {
        id: "stop-any-session",
        section: "6",
        statement: "STOP is honoured whatever its session",
        check: stop_any_session,
    },
    Rule {
        id: "black",
        section: "6",
        statement: "BLACK darkens at once, and ARM lights again",
        check: black,
    },
    Rule {
        id: "black-any-session",
        section: "6",
        statement: "BLACK is honoured whatever its session",
        check: black_any_session,
    },
    Rule {
        id: "black-frames",
        section: "6",
        statement: "while black frames are accounted and refused, and credit goes on",
        check: black_frames,
    },
    Rule {
        id: "freeze",
        section: "6",
        statement: "FREEZE holds the frame that is lit; others are refused; ARM lets the picture move",
        check: freeze,
    },
    Rule {
        id: "freeze-dark",
        section: "6",
        statement: "where nothing is lit FREEZE makes no light: its slots are blank",
        check: freeze_dark,
    },
    Rule {
        id: "slots-over-arms",
        section: "4",
        statement: "counters go on over STOP and ARM of a session",
        check: slots_over_arms,
    },
    Rule {
        id: "safe",
        section: "6",
        statement: "SAFE darkens at once and latches fault 3: FAULT 0, state 6",
        check: safe,
    },
    Rule {
        id: "safe-any-session",
        section: "6",
        statement: "SAFE is honoured whatever its session",
        check: safe_any_session,
    },
];

fn arm_unconfigured(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    b.forget()?;
    b.say(&HostMessage::Arm(u32::MAX))?;
    let limit = b.answer_ns();
    let fault = b.wait_fault(limit, FaultCode::Arm)?.ok_or_else(|| b.silent("FAULT 3"))?;
    check(fault.detail == 1, "detail 1", || fault.detail.to_string())?;
    let s = b.report()?;
    check(!matches!(s.state, DeviceState::Armed), "not armed", || tell(&s))
}

fn arm(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let s = b.report()?;
    check(s.state == DeviceState::Armed && !s.lit && s.faults == 0, "armed, dark, without faults", || {
        tell(&s)
    })?;
    let buffers = b.hello.map_or(0, |h| u32::from(h.frame_buffers));
    check(
        s.frame_limit.wrapping_sub(s.frames_accounted) == buffers,
        &format!("credit for the {buffers} buffers of HELLO"),
        || tell(&s),
    )
}

fn arm_twice(b: &mut ConformanceDriver<'_>) -> R {
    let first = b.armed(|_| {})?;
    lit_frame(b)?;
    let before = b.report()?;
    b.say(&HostMessage::Arm(0))?;
    let after = b.report()?;
    check(after.state == DeviceState::Armed && after.lit, "armed, and the light goes on", || tell(&after))?;
    check(after.slots >= before.slots && before.slots >= first.slots, "slots that go on", || {
        format!("{} after {}", after.slots, before.slots)
    })
}

fn arm_faults(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.say(&HostMessage::Safe)?;
    b.forget()?;
    for acknowledged in [0, faults::WATCHDOG] {
        b.say(&HostMessage::Arm(acknowledged))?;
        let limit = b.answer_ns();
        let fault = b.wait_fault(limit, FaultCode::Arm)?.ok_or_else(|| b.silent("FAULT 3"))?;
        check(
            fault.detail == 2 && fault.latched & faults::HOST_SAFE != 0,
            "detail 2, and fault 3 latched",
            || format!("detail {}, faults {:#x}", fault.detail, fault.latched),
        )?;
        let s = b.report()?;
        check(s.state == DeviceState::Faulted && !s.lit, "faulted and dark", || tell(&s))?;
    }
    let s = b.arm()?;
    check(s.state == DeviceState::Armed && s.faults == 0, "armed, faults cleared", || tell(&s))
}

/// One frame is lit, and stays so for two seconds.
pub(super) fn lit_frame(b: &mut ConformanceDriver<'_>) -> R<Status> {
    b.needs_frames()?;
    let shot = b.send_ahead()?;
    let s = b.until_slot(shot.slot)?;
    check(s.lit && s.last_lit_frame == shot.id, "the frame lit that the rule needs", || tell(&s))?;
    Ok(s)
}

/// Slots of half a second: what is at once is in the same slot.
fn slow(c: &mut Config) {
    c.rate = FrameRate::new(2, 1).unwrap_or(c.rate);
}

/// A verb ends light in the middle of a slot.
fn dark_at_once(b: &mut ConformanceDriver<'_>, message: &HostMessage, session: Option<u32>) -> R<Status> {
    b.armed(slow)?;
    lit_frame(b)?;
    // At the beginning of a slot, so that the rest of it lies ahead.
    let now = b.report()?;
    let slots = b.slots()?;
    let slot = slots.slot_at(now.now).unwrap_or(0) + 1;
    let before = b.until_slot(slot)?;
    b.say_as(session.unwrap_or(b.session), message)?;
    let s = b.report()?;
    check(!s.lit, "dark", || tell(&s))?;
    if grew(&before, &s, |s| s.slots) > 0 && slots.slot_at(s.now) > Some(slot) {
        // Too late to tell "at once" from "at the next slot"; tried again.
        return Err(Stop::Failed(format!("the answer took longer than the slot; {}", tell(&s))));
    }
    Ok(s)
}

fn stop(b: &mut ConformanceDriver<'_>) -> R {
    let s = dark_at_once(b, &HostMessage::Stop, None)?;
    check(s.state == DeviceState::Configured, "configured", || tell(&s))
}

fn stop_any_session(b: &mut ConformanceDriver<'_>) -> R {
    for other in [0, b.session ^ 0x5555_aaaa] {
        let s = dark_at_once(b, &HostMessage::Stop, Some(other))?;
        check(s.state == DeviceState::Configured, "configured", || tell(&s))?;
    }
    Ok(())
}

fn black(b: &mut ConformanceDriver<'_>) -> R {
    let s = dark_at_once(b, &HostMessage::Black, None)?;
    check(s.state == DeviceState::Black && s.faults == 0, "black, without faults", || tell(&s))?;
    b.say(&HostMessage::Arm(0))?;
    let s = b.report()?;
    check(s.state == DeviceState::Armed, "armed again", || tell(&s))?;
    lit_frame(b)?;
    Ok(())
}

fn black_any_session(b: &mut ConformanceDriver<'_>) -> R {
    for other in [0, b.session ^ 0x5555_aaaa] {
        let s = dark_at_once(b, &HostMessage::Black, Some(other))?;
        check(s.state == DeviceState::Black, "black", || tell(&s))?;
    }
    Ok(())
}

fn black_frames(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.needs_frames()?;
    b.say(&HostMessage::Black)?;
    let before = b.report()?;
    let mut last = 0;
    for _ in 0..3 {
        last = b.slot_ahead()?;
        let shot = b.shot(last)?;
        b.send(&shot)?;
    }
    let s = b.until_slot(last)?;
    check(s.state == DeviceState::Black && !s.lit && s.frames_lit == before.frames_lit, "black", || {
        tell(&s)
    })?;
    check(grew(&before, &s, |s| s.frames_refused) == 3, "3 frames refused", || tell(&s))?;
    check(
        s.frames_accounted == 3 && s.frame_limit.wrapping_sub(3) > 0,
        "3 accounted, credit for more",
        || tell(&s),
    )?;
    check(grew(&before, &s, |s| s.slots_blank) > 0, "blank slots", || tell(&s))
}

fn freeze(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let before = lit_frame(b)?;
    b.say(&HostMessage::Freeze)?;
    let s = b.report()?;
    check(s.state == DeviceState::Frozen && s.lit, "frozen, with light", || tell(&s))?;
    let shot = b.send_ahead()?;
    let s = b.until_slot(shot.slot + 1)?;
    check(
        s.state == DeviceState::Frozen && s.lit && s.last_lit_frame == before.last_lit_frame,
        "the frame before, still lit",
        || tell(&s),
    )?;
    check(grew(&before, &s, |s| s.frames_refused) == 1, "the new frame refused", || tell(&s))?;
    check(grew(&before, &s, |s| s.slots_repeated) > 0, "repeated slots", || tell(&s))?;
    b.say(&HostMessage::Arm(0))?;
    let s = b.report()?;
    check(s.state == DeviceState::Armed, "armed again", || tell(&s))?;
    lit_frame(b)?;
    Ok(())
}

fn freeze_dark(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    b.say(&HostMessage::Freeze)?;
    let before = b.report()?;
    check(before.state == DeviceState::Frozen && !before.lit, "frozen and dark", || tell(&before))?;
    let s = b.until(before.now.0 + 4 * b.ticks_of_ms(u64::from(b.slot_ms())))?;
    check(!s.lit && grew(&before, &s, |s| s.slots_repeated) == 0, "no light and no repeated slot", || {
        tell(&s)
    })?;
    check(grew(&before, &s, |s| s.slots_blank) >= 2, "blank slots", || tell(&s))
}

fn slots_over_arms(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(|_| {})?;
    let before = lit_frame(b)?;
    b.say(&HostMessage::Stop)?;
    b.arm()?;
    let s = b.report()?;
    check(
        s.frames_lit == before.frames_lit && s.slots >= before.slots && s.frames_seen == before.frames_seen,
        "counters that go on",
        || format!("{} after {}", tell(&s), tell(&before)),
    )
}

fn is_safe(b: &mut ConformanceDriver<'_>, s: &Status) -> R {
    check(
        s.state == DeviceState::Faulted && s.faults & faults::HOST_SAFE != 0,
        "faulted, fault 3 latched",
        || tell(s),
    )?;
    // It stays so.
    b.pass(100_000_000)?;
    let s = b.report()?;
    check(s.state == DeviceState::Faulted && !s.lit, "latched", || tell(&s))
}

fn safe(b: &mut ConformanceDriver<'_>) -> R {
    let s = dark_at_once(b, &HostMessage::Safe, None)?;
    is_safe(b, &s)?;
    b.arm()?;
    b.forget()?;
    b.say(&HostMessage::Safe)?;
    let limit = b.answer_ns();
    let fault = b.wait_fault(limit, FaultCode::Latched)?.ok_or_else(|| b.silent("FAULT 0"))?;
    check(fault.latched & faults::HOST_SAFE != 0, "fault 3 in the FAULT", || format!("{:#x}", fault.latched))
}

fn safe_any_session(b: &mut ConformanceDriver<'_>) -> R {
    for other in [0, b.session ^ 0x5555_aaaa] {
        let s = dark_at_once(b, &HostMessage::Safe, Some(other))?;
        is_safe(b, &s)?;
    }
    Ok(())
}
