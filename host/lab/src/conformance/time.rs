//! The device's clock, and the laws that were watched over all of the judging.

use super::driver::{ConformanceDriver, R};
use super::{check, Rule, Stop};
use dpm_device::link::DeviceMessage;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "echo",
        section: "4",
        statement: "ECHO returns the host's stamp unread, with the device's clock at arrival and departure",
        check: echo,
    },
    Rule {
        id: "echo-greeted",
        section: "4",
        statement: "ECHO is answered before CONFIG, too",
        check: echo_greeted,
    },
    Rule {
        id: "clock-rate",
        section: "4",
        statement: "the clock runs at the rate that HELLO says, within 1000 ppm",
        check: clock_rate,
    },
    Rule {
        id: "clock-monotonic",
        section: "7",
        statement: "the clock never goes back",
        check: |b| law(b, |b| b.laws().clock.clone(), "ticks that never go back"),
    },
    Rule {
        id: "law-slots",
        section: "4",
        statement: "slots = lit + repeated + blank, in every STATUS",
        check: |b| law(b, |b| b.laws().slots.clone(), "slots = lit + repeated + blank"),
    },
    Rule {
        id: "law-seen",
        section: "4",
        statement:
            "frames seen = lit + incomplete + late + superseded + refused + under way, in every STATUS",
        check: |b| law(b, |b| b.laws().seen.clone(), "every frame seen once"),
    },
    Rule {
        id: "law-credit",
        section: "5",
        statement: "limit = accounted + free buffers, or accounted while not armed, in every STATUS",
        check: |b| law(b, |b| b.laws().credit.clone(), "the limit by the formula"),
    },
    Rule {
        id: "law-dark",
        section: "6",
        statement: "light only in armed and frozen, in every STATUS",
        check: |b| law(b, |b| b.laws().dark.clone(), "no light in other states"),
    },
    Rule {
        id: "replies",
        section: "2",
        statement: "the device's own packets are as section 2 says: checksums, lengths, fields that are 0",
        check: replies,
    },
];

/// A law that was watched; where only some rules are judged, a little is done first so that there is something to watch.
fn law(b: &mut ConformanceDriver<'_>, breach: fn(&ConformanceDriver<'_>) -> Option<String>, what: &str) -> R {
    if b.laws().reports < 200 {
        exercise(b)?;
    }
    match breach(b) {
        None => Ok(()),
        Some(told) => Err(Stop::Failed(format!("expected {what}, saw {told}"))),
    }
}

/// Frames of every fate, and every state.
fn exercise(b: &mut ConformanceDriver<'_>) -> R {
    use dpm_device::link::HostMessage;
    b.armed(|_| {})?;
    if b.needs_frames().is_ok() {
        for k in 0..6u64 {
            let slot = b.slot_ahead()?;
            let mut shot = b.shot(if k == 2 { slot.saturating_sub(9) } else { slot })?;
            if k == 3 {
                shot.pieces.clear();
            }
            if k == 4 {
                b.say(&HostMessage::Black)?;
            }
            b.send(&shot)?;
            b.until_slot(slot + 1)?;
        }
    }
    b.say(&HostMessage::Arm(0))?;
    b.report()?;
    b.say(&HostMessage::Freeze)?;
    b.report()?;
    b.say(&HostMessage::Stop)?;
    for _ in 0..30 {
        b.report()?;
    }
    Ok(())
}

/// One exchange: the host's two stamps, and the device's.
fn exchange(b: &mut ConformanceDriver<'_>, mark: u64) -> R<Option<([i64; 2], [u64; 2])>> {
    let sent = b.now().0;
    let stamp = mark << 56 | (sent as u64 & 0x00ff_ffff_ffff_ffff);
    b.forget()?;
    let sent = b.now().0.max(sent);
    b.say(&b.echo(stamp))?;
    let limit = b.answer_ns();
    let session = b.session;
    b.wait(limit, |h| match h.message {
        DeviceMessage::Echo(e) if e.host_sent_ns == stamp && h.session == session => {
            Some(([sent, h.at.0], [e.device_received.0, e.device_sent.0]))
        }
        _ => None,
    })
}

fn echo(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    for mark in [0x01, 0x80, 0xff] {
        let found = exchange(b, mark)?;
        let Some((host, device)) = found else {
            return Err(Stop::Failed("expected an ECHO with the host's stamp, saw none".into()));
        };
        let round_ns = (host[1] - host[0]) as u128;
        let stay = u128::from(device[1].saturating_sub(device[0]));
        let stay_ns = stay * 1_000_000_000 / u128::from(b.tick_hz().max(1));
        check(device[1] >= device[0], "departure after arrival", || format!("{device:?}"))?;
        check(stay_ns <= round_ns + 2_000_000, "a stay no longer than the round trip", || {
            format!("{stay_ns} ns of {round_ns}")
        })?;
        let now = b.report()?.now.0;
        check(device[1] <= now && now - device[1] < b.tick_hz(), "stamps of the clock of STATUS", || {
            format!("{device:?}, STATUS at {now}")
        })?;
    }
    Ok(())
}

fn echo_greeted(b: &mut ConformanceDriver<'_>) -> R {
    b.open()?;
    let found = exchange(b, 0x11)?;
    check(found.is_some(), "an ECHO before CONFIG", || "none".into())
}

/// The best of some exchanges: middle of the host's stamps, the device's arrival, half the round trip, ns.
fn best(b: &mut ConformanceDriver<'_>) -> R<(f64, f64, f64)> {
    let mut best: Option<(f64, f64, f64)> = None;
    for k in 0..12 {
        if let Some((host, device)) = exchange(b, k)? {
            let half = (host[1] - host[0]) as f64 / 2.0;
            if best.is_none_or(|(_, _, h)| half < h) {
                let ticks = (device[0] as f64 + device[1] as f64) / 2.0;
                best = Some(((host[0] as f64 + host[1] as f64) / 2.0, ticks, half));
            }
        }
    }
    best.ok_or_else(|| b.silent("an ECHO"))
}

fn clock_rate(b: &mut ConformanceDriver<'_>) -> R {
    b.configured(|_| {})?;
    let first = best(b)?;
    b.pass(1_500_000_000)?;
    let second = best(b)?;
    let ns = second.0 - first.0;
    let device_ns = (second.1 - first.1) * 1e9 / b.tick_hz() as f64;
    let ppm = (device_ns / ns - 1.0) * 1e6;
    // What the round trips leave open.
    let open = (first.2 + second.2) / ns * 1e6;
    check(ppm.abs() <= 1000.0 + open, "1000 ppm at most", || format!("{ppm:.0} ppm, {open:.0} ppm uncertain"))
}

fn replies(b: &mut ConformanceDriver<'_>) -> R {
    law(b, |b| b.laws().packets.clone(), "packets by section 2")?;
    let noise = b.noise();
    check(noise == [0; 4], "no damaged, foreign or stray bytes on the way back", || {
        format!(
            "{} damaged headers, {} damaged payloads, {} foreign packets, {} bytes outside packets",
            noise[0], noise[1], noise[2], noise[3]
        )
    })
}
