//! The watchdog: who feeds it, and when it bites.

use super::driver::{ConformanceDriver, R};
use super::orders::lit_frame;
use super::shot::damaged_payload;
use super::{check, tell, Rule, Stop};
use dpm_device::link::{
    faults, Config, DeviceMessage, DeviceState, Header, HostMessage, MessageType, Underrun,
};
use dpm_device::transport::Lane;

/// Watchdog of these rules.
const BITE_US: u32 = 200_000;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "watchdog",
        section: "6",
        statement: "after the configured silence the device is dark and fault 0 is latched",
        check: watchdog,
    },
    Rule {
        id: "watchdog-fed",
        section: "6",
        statement: "any intact packet of the session feeds the watchdog",
        check: watchdog_fed,
    },
    Rule {
        id: "watchdog-strangers",
        section: "6",
        statement: "packets of other sessions do not feed the watchdog",
        check: watchdog_strangers,
    },
    Rule {
        id: "watchdog-damaged",
        section: "6",
        statement: "damaged packets do not feed the watchdog",
        check: watchdog_damaged,
    },
    Rule {
        id: "watchdog-black",
        section: "6",
        statement: "the watchdog bites in black, too",
        check: watchdog_black,
    },
    Rule {
        id: "watchdog-disarmed",
        section: "6",
        statement: "a device that is not armed has no watchdog",
        check: watchdog_disarmed,
    },
];

fn watchful(c: &mut Config) {
    c.watchdog_us = BITE_US;
    // What the watchdog must end is repeated without limit.
    c.underrun = Underrun::Repeat;
}

/// Silence, until the device says that the watchdog bit; the device's time from the last packet to the bite, ms.
fn bitten(b: &mut ConformanceDriver<'_>) -> R<u64> {
    let stamp = 0x0abc_0000_0000_0000 | u64::from(b.session);
    b.forget()?;
    b.say(&b.echo(stamp))?;
    b.feed = false;
    let limit = b.answer_ns() + 4 * i64::from(BITE_US) * 1000;
    let (mut heard_at, mut fault) = (None, None);
    let found = b.wait(limit, |h| {
        match h.message {
            DeviceMessage::Echo(e) if e.host_sent_ns == stamp => heard_at = Some(e.device_received.0),
            DeviceMessage::Fault(f) if f.latched & faults::WATCHDOG != 0 => fault = Some(f.at.0),
            _ => {}
        }
        heard_at.zip(fault)
    });
    b.feed = true;
    let (heard, at) = found?.ok_or_else(|| {
        Stop::Failed(format!(
            "expected FAULT 0 with fault 0 after {} ms of silence, saw none; {}",
            BITE_US / 1000,
            b.newest()
        ))
    })?;
    let s = b.report()?;
    check(
        s.state == DeviceState::Faulted && !s.lit && s.faults & faults::WATCHDOG != 0,
        "faulted and dark, fault 0 latched",
        || tell(&s),
    )?;
    Ok(at.saturating_sub(heard) * 1000 / b.tick_hz().max(1))
}

fn watchdog(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(watchful)?;
    lit_frame(b)?;
    let ms = bitten(b)?;
    let asked = u64::from(BITE_US / 1000);
    check(
        (asked - 2..=asked + asked / 10 + 5).contains(&ms),
        &format!("the bite {asked} ms after the last packet"),
        || format!("{ms} ms"),
    )
}

fn watchdog_fed(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(watchful)?;
    b.feed = false;
    let steps = 3 * 4;
    for k in 0..steps {
        match k % 3 {
            0 => b.say(&b.echo(0))?,
            1 => b.say(&HostMessage::Sync(b.frames_sent))?,
            _ => b.say(&HostMessage::Arm(0))?,
        }
        b.pass(i64::from(BITE_US) * 1000 / 4)?;
    }
    b.feed = true;
    let s = b.report()?;
    check(s.state == DeviceState::Armed && s.faults == 0, "armed after three watchdogs' time", || tell(&s))
}

/// Three watchdogs' time in which only `send` is sent.
fn not_fed(b: &mut ConformanceDriver<'_>, mut send: impl FnMut(&mut ConformanceDriver<'_>) -> R) -> R {
    b.armed(watchful)?;
    b.feed = false;
    for _ in 0..9 {
        send(b)?;
        b.pass(i64::from(BITE_US) * 1000 / 3)?;
    }
    b.feed = true;
    let s = b.report()?;
    check(s.state == DeviceState::Faulted && s.faults & faults::WATCHDOG != 0, "fault 0 latched", || tell(&s))
}

fn watchdog_strangers(b: &mut ConformanceDriver<'_>) -> R {
    not_fed(b, |b| b.say_as(b.session ^ 7, &b.echo(0)))
}

fn watchdog_damaged(b: &mut ConformanceDriver<'_>) -> R {
    not_fed(b, |b| {
        let header = Header::control(MessageType::Echo, b.session, 24);
        b.send_packets(Lane::Control, &[damaged_payload(&header, &[0; 24])])
    })
}

fn watchdog_black(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(watchful)?;
    b.say(&HostMessage::Black)?;
    bitten(b)?;
    Ok(())
}

fn watchdog_disarmed(b: &mut ConformanceDriver<'_>) -> R {
    b.armed(watchful)?;
    b.say(&HostMessage::Stop)?;
    b.feed = false;
    b.pass(i64::from(BITE_US) * 1000 * 3)?;
    b.feed = true;
    let s = b.report()?;
    check(s.state == DeviceState::Configured && s.faults == 0, "configured, no fault", || tell(&s))
}
