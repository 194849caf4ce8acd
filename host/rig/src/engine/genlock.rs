//! Keeps slots in step with the tracker's exposures, where one rate divides the other and the projector's slots can be
//! shifted.
//!
//! A frame reads its poses a lead before its slot. If a sample becomes ready just before that, its light is as fresh as
//! it can be, and equally fresh in every frame. So slots are shifted until they begin a lead after a sample is ready:
//! before the first frame at once, and later by small parts of a slot. Where the lead grows, frames read the same sample
//! with less slack until the slots have followed; where it shrinks, the slots follow slowly, so that light stays steady.

use crate::plan::beat::RatePair;
use crate::plan::link_time::LinkTime;
use crate::tracks::SampleRhythm;
use dpm_device::time::HostTime;

/// From the instant at which a sample should be ready to the latch, nanoseconds: so much may it be late.
const MARGIN_NS: i64 = 50_000;
/// A latch that is later than it has to be by no more than this moves nothing, nanoseconds.
const CALM_NS: i64 = 60_000;
/// Slots to the first one that is shifted, beyond the lead: the device must know of it before.
const AHEAD: u64 = 4;

/// With each shift slots begin earlier by this part of what they might. The lead falls for moments, and slots that had
/// followed would have to come back.
const EARLIER_PARTS: i64 = 32;

/// A latch is moved to a sample that is ready so much earlier, nanoseconds. Its frame shows the same, with more slack.
const EARLIER_NS: i64 = 500_000;

/// True if slots of `slot_ns` can keep step with samples.
pub(crate) fn keeps_step(rhythm: &SampleRhythm, slot_ns: i64) -> bool {
    let hz = |ns: i64| 1e9 / ns.max(1) as f64;
    RatePair { tracker_hz: hz(rhythm.period_ns), slots_hz: hz(slot_ns) }.divides()
}

/// A sample that a frame waits for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SampleWait {
    /// Its exposure, or a little before.
    pub captured_at: HostTime,
    /// Until when the frame can wait.
    pub until: HostTime,
}

/// When to read the poses of a frame that should be latched at `at`, and can be latched up to `late_ns` later, or a little
/// later in any case: when the sample is ready that becomes so at about that time, with that sample; else at `at`.
pub(crate) fn latch_at(rhythm: &SampleRhythm, at: HostTime, late_ns: i64) -> (HostTime, Option<SampleWait>) {
    let ready_at = rhythm.ready_at().plus_ns(MARGIN_NS);
    let period_ns = rhythm.period_ns.max(1);
    let until = at.plus_ns(late_ns.max(2 * MARGIN_NS));
    // The last one that is ready no more than `late_ns` after the latch.
    let periods = until.ns_since(ready_at).div_euclid(period_ns);
    let last = ready_at.plus_ns(periods * period_ns);
    if at.ns_since(last) > EARLIER_NS {
        return (at, None);
    }
    let captured_at = rhythm.captured_at.plus_ns(periods * period_ns - period_ns / 4);
    (last, Some(SampleWait { captured_at, until }))
}

/// How far slots should be shifted, and from which on: later if positive, nanoseconds. `is_first`: no frame was sent yet.
/// `None`: not at all.
pub(crate) fn shift_ns(
    rhythm: &SampleRhythm,
    time: &LinkTime,
    lead_ns: i64,
    slot_ns: i64,
    is_first: bool,
    now: HostTime,
) -> Option<(u64, i64)> {
    let slot = time.slot_after(now.plus_ns(if is_first { 0 } else { lead_ns })) + AHEAD;
    // Slots and samples that divide each other meet this often.
    let step_ns = rhythm.period_ns.min(slot_ns).max(1);
    let latch_at = time.host_of_slot(slot).plus_ns(-lead_ns - MARGIN_NS);
    let waits_ns = latch_at.ns_since(rhythm.ready_at()).rem_euclid(step_ns);
    if is_first {
        let by_ns = (step_ns - waits_ns) % step_ns;
        return (by_ns > CALM_NS).then_some((slot, by_ns));
    }
    let off_ns = if waits_ns > step_ns / 2 { waits_ns - step_ns } else { waits_ns };
    match off_ns {
        ..0 => Some((slot, -off_ns)),
        0..=CALM_NS => None,
        _ => Some((slot, -(off_ns - CALM_NS / 2) / EARLIER_PARTS)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::link::{SlotClock, SlotShift};
    use dpm_device::time::{DeviceTicks, FrameRate};

    /// A projector whose clock runs 80 ppm fast, and a tracker of 500 Hz: what each sample has waited at the latch of
    /// the slots after `settle` seconds, nanoseconds, by the lead at a time.
    fn waits(hz: u32, ahead_ns: i64, lead_ns: impl Fn(f64) -> i64, settle: f64) -> Vec<i64> {
        let rate = FrameRate::new(hz, 1).unwrap();
        let slot_ns = rate.slot_len_ns(0);
        let mut clock = SlotClock::new(DeviceTicks(1_234), 1_000_000_000, rate).unwrap();
        let period_ns = 2_000_000;
        let (mut all, mut free_from) = (Vec::new(), 0);
        for slot in 1..u64::from(hz) * 8 {
            // The host's map is right at the slot's own instant.
            let ticks = clock.start(slot);
            let host = HostTime((ticks.0 as f64 * (1.0 - 80e-6)) as i64);
            let time = LinkTime { clock, first: 0, anchor: (ticks, host), bound_ns: 0 };
            let seconds = host.0 as f64 / 1e9;
            let lead = lead_ns(seconds);
            let newest = (host.0 - lead - 300_000) / period_ns * period_ns;
            let rhythm = SampleRhythm { captured_at: HostTime(newest), takes_ns: 300_000, period_ns };
            assert!(keeps_step(&rhythm, slot_ns));
            if seconds > settle {
                let (at, _) = latch_at(&rhythm, host.plus_ns(-lead), ahead_ns);
                let is_newer = at.0 >= newest + 300_000 + period_ns;
                all.push(at.0 - newest - 300_000 - if is_newer { period_ns } else { 0 });
            }
            if slot >= free_from {
                let now = host.plus_ns(-lead);
                if let Some((from, by)) = shift_ns(&rhythm, &time, lead, slot_ns, slot == 1, now) {
                    let most = if slot == 1 { slot_ns } else { slot_ns / 64 };
                    let epoch = clock.epoch_of(from).0.saturating_add_signed(by.clamp(-slot_ns / 64, most));
                    clock = clock.with_shift(SlotShift { slot: from, epoch: DeviceTicks(epoch) });
                    free_from = from + 2;
                }
            }
        }
        all
    }

    /// The sample that a frame reads has just become ready, whatever the rates are that divide each other, and though the
    /// clocks drift.
    #[test]
    fn slots_follow_the_tracker() {
        for hz in [500, 1000, 250] {
            let all = waits(hz, 0, |_| 1_700_000, 1.0);
            let fresh = if hz == 1000 { 2 } else { 1 };
            let waits: Vec<i64> = all.iter().copied().filter(|w| *w < 1_000_000).collect();
            assert!(waits.len() * fresh + 2 * fresh >= all.len(), "{hz}: {} of {}", waits.len(), all.len());
            assert!(waits.iter().all(|w| (0..200_000).contains(w)), "{hz}: {:?}", waits.iter().max());
        }
    }

    /// A lead that grows costs slack and not age, and the slots have followed within a fraction of a second.
    #[test]
    fn a_lead_that_grows_reads_the_same_sample() {
        let grows = |s: f64| if s < 4.0 { 1_500_000 } else { 1_800_000 };
        let all = waits(500, 350_000, grows, 1.0);
        assert!(all.iter().all(|w| (0..250_000).contains(w)), "{:?}", all.iter().max());
        let shrinks = |s: f64| if s < 3.0 { 1_800_000 } else { 1_500_000 };
        let all = waits(500, 0, shrinks, 1.0);
        assert!(all.iter().all(|w| (0..450_000).contains(w)), "{:?}", all.iter().max());
        assert!(all[all.len() - 500..].iter().all(|w| *w < 200_000), "{:?}", all.last());
    }

    #[test]
    fn a_latch_waits_for_a_sample_that_comes_soon_and_for_no_other() {
        let rhythm =
            SampleRhythm { captured_at: HostTime(98_000_000), takes_ns: 2_000_000, period_ns: 2_000_000 };
        let at = |us: i64, late_us: i64| {
            let at = HostTime(110_000_000 + 1_000 * us);
            let (at, awaited) = latch_at(&rhythm, at, 1_000 * late_us);
            let exposed = awaited.map(|awaited| awaited.captured_at);
            assert!(exposed.is_none_or(|exposed| exposed == HostTime(107_500_000)), "{exposed:?}");
            (at.0 - 110_000_000) / 1_000
        };
        assert_eq!(at(-150, 300), 50, "it comes within what the frame can wait");
        assert_eq!(at(-400, 300), -400, "it comes too late");
        assert_eq!(at(300, 300), 50, "it is there already: more slack for the same sample");
        assert_eq!(at(900, 300), 900);
    }
}
