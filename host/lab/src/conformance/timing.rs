//! Timing: how early frames are whole. Every bound comes from the device's own clock in the reports before and after, so
//! no map of the clocks is needed.

use super::driver::{ConformanceDriver, R};
use super::{check, tell, Rule, Stop};
use dpm_device::link::{FrameTiming, Status};
use dpm_device::time::DeviceTicks;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "timing-unasked",
        section: "15",
        statement: "without bit 3 in CONFIG, STATUS has no timing",
        check: unasked,
    },
    Rule {
        id: "timing-slack",
        section: "15",
        statement: "the slack of a frame is the time from the whole frame to its slot",
        check: slack,
    },
    Rule {
        id: "timing-late",
        section: "15",
        statement: "the slack of a frame that comes late is told, and negative",
        check: late,
    },
    Rule {
        id: "timing-transfer",
        section: "15",
        statement: "the transfer lasts from the first packet of a frame to the whole frame",
        check: transfer,
    },
];

/// Ticks that a device may lose by rounding.
const ROUNDING: f64 = 2.0;

impl ConformanceDriver<'_> {
    /// A new session of a device that measures timing.
    fn measures(&mut self) -> R {
        self.open()?;
        if !self.hello.is_some_and(|hello| hello.measures_timing) {
            return Err(Stop::NotJudged("its HELLO does not offer to measure timing".into()));
        }
        Ok(())
    }

    fn armed_to_measure(&mut self) -> R {
        self.measures()?;
        self.armed(|config| config.timing = true)?;
        self.needs_frames()
    }

    /// Nanoseconds from one instant of the device's clock to another.
    fn ns_between(&self, from: DeviceTicks, to: DeviceTicks) -> f64 {
        (to.0 as f64 - from.0 as f64) * 1e9 / self.tick_hz() as f64
    }
}

/// The timing of `frame`.
fn timing(s: &Status, frame: u32) -> R<FrameTiming> {
    let told = s.timing.ok_or_else(|| {
        Stop::Failed("expected 16 bytes of timing in STATUS after CONFIG asked for it, saw none".into())
    })?;
    check(told.frame == frame, &format!("the timing of frame {frame}"), || format!("{told:?}"))?;
    Ok(told)
}

/// Sends a frame for the slot `ahead` from now and judges its slack.
fn judge(b: &mut ConformanceDriver<'_>, slot: u64) -> R<FrameTiming> {
    let before = b.report()?;
    let shot = b.send_for(slot)?;
    let after = b.report()?;
    let told = timing(&after, shot.id)?;
    let start = DeviceTicks(shot.target);
    let rounding = ROUNDING * 1e9 / b.tick_hz() as f64;
    let (least, most) = (b.ns_between(after.now, start), b.ns_between(before.now, start));
    let within = (least - rounding..=most + rounding).contains(&f64::from(told.slack_ns));
    check(within, &format!("a slack between {least:.0} and {most:.0} ns"), || told.slack_ns.to_string())?;
    Ok(told)
}

fn unasked(b: &mut ConformanceDriver<'_>) -> R {
    b.measures()?;
    b.armed(|_| {})?;
    b.needs_frames()?;
    b.send_ahead()?;
    let s = b.report()?;
    check(s.timing.is_none(), "a STATUS without timing", || tell(&s))
}

fn slack(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_measure()?;
    for more in [1, 2] {
        let slot = b.slot_ahead()? + more;
        let told = judge(b, slot)?;
        check(told.slack_ns > 0, "a slack above 0", || told.slack_ns.to_string())?;
        b.until_slot(slot + 1)?;
    }
    Ok(())
}

fn late(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_measure()?;
    let slot = b.slot_ahead()?;
    b.until_slot(slot + 2)?;
    let told = judge(b, slot)?;
    check(told.slack_ns < 0, "a slack below 0", || told.slack_ns.to_string())
}

fn transfer(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_measure()?;
    let slot = b.slot_ahead()?;
    let before = b.report()?;
    let mut shot = b.shot(slot)?;
    shot.commits = false;
    b.send(&shot)?;
    let sent = b.packets_sent;
    // SYNC would give up the frame that is arriving, so the report of a slot has to do.
    b.pass(i64::from(b.slot_ms()) * 2_500_000)?;
    let begun = b.newest.ok_or_else(|| b.silent("a STATUS with the slots"))?;
    let has_begun =
        b.packets_base.is_some_and(|base| begun.packets.wrapping_sub(base).wrapping_sub(sent) as i32 >= 0);
    if !has_begun {
        return Err(Stop::NotJudged("no STATUS came after the first packets and before the last".into()));
    }
    (shot.pieces, shot.commits) = (Vec::new(), true);
    b.send(&shot)?;
    let after = b.report()?;
    let told = timing(&after, shot.id)?;
    let whole = b.ns_between(before.now, DeviceTicks(shot.target)) - f64::from(told.slack_ns);
    let rounding = ROUNDING * 1e9 / b.tick_hz() as f64;
    // Both count from the first report: the first packet came after it and before the second one.
    let (least, most) = (whole - b.ns_between(before.now, begun.now), whole);
    let within = (least - rounding..=most + rounding).contains(&f64::from(told.transfer_ns));
    check(within, &format!("a transfer of {least:.0} to {most:.0} ns"), || told.transfer_ns.to_string())
}
