//! SHIFT: slots that begin earlier or later. What holds is seen from the epoch in STATUS, and from when frames are lit.

use super::driver::{ConformanceDriver, R};
use super::{check, grew, tell, Rule, Stop};
use dpm_device::link::{HostMessage, SlotShift, Status, SHIFT_PARTS};
use dpm_device::time::DeviceTicks;

pub(super) const RULES: &[Rule] = &[
    Rule {
        id: "shift-unasked",
        section: "16",
        statement: "without bit 4 in CONFIG, SHIFT is ignored and counted",
        check: unasked,
    },
    Rule {
        id: "shift-slot",
        section: "16",
        statement: "from the slot that SHIFT names on, slots begin by its epoch; frames are lit in them",
        check: slot,
    },
    Rule {
        id: "shift-far",
        section: "16",
        statement:
            "a SHIFT by more than a 64th of a slot in light, or earlier by more, is ignored and counted",
        check: far,
    },
    Rule {
        id: "shift-dark",
        section: "16",
        statement: "while it is dark, slots may begin later by up to a slot",
        check: dark,
    },
];

impl ConformanceDriver<'_> {
    /// A new session of a device whose slots can be shifted, armed.
    fn armed_to_shift(&mut self) -> R {
        self.offers_shifts()?;
        self.armed(|config| (config.timing, config.shifts) = (true, true))?;
        self.needs_frames()
    }

    fn offers_shifts(&mut self) -> R {
        self.open()?;
        if !self.hello.is_some_and(|hello| hello.shifts_slots) {
            return Err(Stop::NotJudged("its HELLO does not offer to shift slots".into()));
        }
        Ok(())
    }

    /// Shifts slots by `ticks` from a slot on that has not begun; that slot, and the epoch.
    fn shift(&mut self, ticks: i64) -> R<SlotShift> {
        let slot = self.slot_ahead()?;
        let epoch = DeviceTicks(self.slots()?.epoch_of(slot).0.saturating_add_signed(ticks));
        let shift = SlotShift { slot, epoch };
        self.say(&HostMessage::Shift(shift))?;
        Ok(shift)
    }

    /// The same; from now on the judge counts by the new slots.
    fn shifts(&mut self, ticks: i64) -> R<SlotShift> {
        let shift = self.shift(ticks)?;
        self.slots = Some(self.slots()?.with_shift(shift));
        Ok(shift)
    }

    fn slot_part(&self) -> R<i64> {
        Ok((self.slots()?.slot_ticks() / SHIFT_PARTS) as i64)
    }
}

fn epoch(s: &Status) -> R<u32> {
    let timing =
        s.timing.ok_or_else(|| Stop::Failed("expected 16 bytes of timing in STATUS, saw none".into()))?;
    Ok(timing.epoch)
}

/// A frame for the second slot after a shift is lit when that slot begins.
fn lights(b: &mut ConformanceDriver<'_>, shift: SlotShift) -> R {
    let after = b.until_slot(shift.slot)?;
    check(epoch(&after)? == shift.epoch.0 as u32, &format!("the epoch {}", shift.epoch.0 as u32), || {
        format!("{:?}", after.timing)
    })?;
    let shot = b.send_ahead()?;
    let s = b.until_slot(shot.slot)?;
    let start = b.slots()?.start(shot.slot).0;
    check(
        s.last_lit_frame == shot.id && s.last_lit_at.0.abs_diff(start) <= 1,
        &format!("frame {} lit at tick {start}", shot.id),
        || format!("frame {} lit at tick {}", s.last_lit_frame, s.last_lit_at.0),
    )
}

fn unasked(b: &mut ConformanceDriver<'_>) -> R {
    b.offers_shifts()?;
    b.armed(|config| config.timing = true)?;
    let before = b.report()?;
    let shift = b.shift(1)?;
    let s = b.until_slot(shift.slot)?;
    check(grew(&before, &s, |s| s.packets_ignored) == 1, "1 packet counted as ignored", || tell(&s))?;
    check(epoch(&s)? == 0, "an epoch of 0", || format!("{:?}", s.timing))
}

fn slot(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_shift()?;
    let part = b.slot_part()?;
    for ticks in [part, -part, part / 2] {
        let shot = b.send_ahead()?;
        b.until_slot(shot.slot)?;
        let shift = b.shifts(ticks)?;
        lights(b, shift)?;
    }
    Ok(())
}

fn far(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_shift()?;
    let part = b.slot_part()?;
    for ticks in [part + 1, -part - 1] {
        let shot = b.send_ahead()?;
        let before = b.until_slot(shot.slot)?;
        check(before.lit, "light", || tell(&before))?;
        let shift = b.shift(ticks)?;
        let s = b.until_slot(shift.slot)?;
        check(grew(&before, &s, |s| s.packets_ignored) == 1, "1 packet counted as ignored", || tell(&s))?;
        check(epoch(&s)? != shift.epoch.0 as u32, "the epoch of before", || format!("{:?}", s.timing))?;
    }
    Ok(())
}

fn dark(b: &mut ConformanceDriver<'_>) -> R {
    b.armed_to_shift()?;
    let shift = b.shifts(b.slots()?.slot_ticks() as i64 * 3 / 5)?;
    lights(b, shift)
}
