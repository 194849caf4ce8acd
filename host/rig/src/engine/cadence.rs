//! Finds how many slots a frame gets: one, or as many as the slowest of renderer, packing and link needs.
//!
//! What carries every fourth frame of a stream lights them at intervals of three, five and four slots, waits for most of
//! the time, and drops the rest; the eye sees flicker, and a projector may count it as flashes. The same link carries one
//! frame in four slots steadily. So frames are planned for every n-th slot, where n follows from the intervals at which
//! frames get out. From time to time fewer slots are tried, more and more seldom while they do not suffice.

use dpm_device::time::HostTime;

/// Shortest time over which intervals are averaged, nanoseconds ...
const WINDOW_NS: i64 = 250_000_000;
/// ... and the fewest intervals in it.
const FEWEST: u32 = 8;
/// Frames whose mean interval exceeds their slots by this part of a slot come too late. Single slots that are missed are no
/// reason to halve a rate.
const LATE_SLOTS: f64 = 1.0 / 12.0;
/// Windows in a row that must be late, so that memory that is slow for a second decides nothing ...
const AGREE: u32 = 8;
/// ... or fewer, in a trial, or if each is late by this part of a slot. A stall of a part of a second is over by then.
const VERY_LATE_SLOTS: f64 = 1.0 / 3.0;
const AGREE_VERY_LATE: u32 = 2;
/// Intervals in a row that are longer than light lasts, after which a frame gets more slots at once: the light flickers.
const FLICKER: u32 = 6;
/// Frames whose times of arrival are compared, and by what part of a slot the quickest must exceed the slots of a frame.
const TRANSFERS: usize = 4;
const SLOW_TRANSFER_SLOTS: f64 = 0.5;
/// First time after which fewer slots are tried, nanoseconds, and the longest.
const FIRST_TRIAL_NS: i64 = 1_000_000_000;
const LAST_TRIAL_NS: i64 = 64_000_000_000;
/// Long intervals that are remembered, and for how long, nanoseconds. Light lasts beyond the second longest of them: one stall
/// decides nothing, and light that goes out more seldom than once a second is no flicker and no flash too many.
const LONG: usize = 32;
const LONG_WITHIN_NS: i64 = 3_000_000_000;
const MOST_BLINKS: usize = 1;
/// An interval is long from this multiple of a frame's slots on. No light lasts longer than this for the sake of intervals,
/// nanoseconds.
const LONG_SLOTS: f64 = 1.25;
const LONGEST_LIGHT_NS: i64 = 200_000_000;
/// Light lasts for as many more slots at least ([`crate::plan::link_time::LinkTime::dark_from`]).
const LIGHT_RESERVE_SLOTS: i64 = 3;
/// No frame gets more slots than this.
const MOST_SLOTS: u64 = 1000;

/// See the module's documentation.
#[derive(Debug)]
pub(crate) struct Cadence {
    slot_ns: i64,
    /// Slots that each frame gets.
    slots: u64,
    /// The frame before, and the intervals of this window: their number, sum and the longest, nanoseconds. The longest
    /// does not count: a stall is no cadence.
    before: Option<HostTime>,
    /// When the slot of the last frame began of which the device has reported.
    due_before: Option<HostTime>,
    count: u32,
    sum_ns: i64,
    longest_ns: i64,
    /// Intervals in a row that were longer than light lasts, and their sum, nanoseconds.
    flicker: (u32, i64),
    /// Long intervals and their ends, a ring; and the slots of the longest that light is to outlast.
    long: [(HostTime, i64); LONG],
    next_long: usize,
    outlasted: u64,
    /// Windows in a row in which frames came later than their slots, and the shortest of their mean intervals, in slots.
    late: Option<(u32, f64)>,
    /// While fewer slots are tried: what sufficed before.
    sufficed: Option<u64>,
    /// Since when the present number suffices, and how long it must before fewer are tried, nanoseconds.
    since: Option<HostTime>,
    trial_ns: i64,
    /// How long the last frames took from their first packet to the whole, nanoseconds.
    transfers_ns: [Option<i64>; TRANSFERS],
    /// The present number follows from these times.
    is_by_transfers: bool,
}

impl Cadence {
    /// For slots of `slot_ns` > 0. Each frame gets one.
    pub(crate) fn new(slot_ns: i64) -> Self {
        Self {
            slot_ns,
            slots: 1,
            before: None,
            due_before: None,
            count: 0,
            sum_ns: 0,
            longest_ns: 0,
            flicker: (0, 0),
            long: [(HostTime(i64::MIN), 0); LONG],
            next_long: 0,
            outlasted: 0,
            late: None,
            sufficed: None,
            since: None,
            trial_ns: FIRST_TRIAL_NS,
            transfers_ns: [None; TRANSFERS],
            is_by_transfers: false,
        }
    }

    /// Slots that each frame gets, 1 or more.
    pub(crate) fn slots(&self) -> u64 {
        self.slots
    }

    /// Slots after which the next frame is due for certain, 1 or more: its light must last so long. It is longer than the
    /// cadence, so that a frame that is lost does not show as a blink; in a trial longer still, because what queues up in it
    /// must be shed; and longer than nearly all intervals of the last seconds.
    pub(crate) fn light_slots(&self) -> u64 {
        self.steady_slots().max(self.outlasted)
    }

    /// The same for frames that come in their cadence.
    fn steady_slots(&self) -> u64 {
        self.sufficed.map_or(self.slots + self.slots / 2, |slots| 2 * slots)
    }

    /// The device has reported that the light of a frame began at `lit_at`, in its slot of `due_at` or later. So long the light
    /// of the frame before had to last.
    pub(crate) fn lit(&mut self, [due_at, lit_at]: [HostTime; 2]) {
        if let Some(before) = self.due_before.replace(due_at) {
            self.outlast(lit_at.ns_since(before).max(0), lit_at);
        }
    }

    /// Light that began with its slot had to last for `interval_ns` until the next began at `now`.
    fn outlast(&mut self, interval_ns: i64, now: HostTime) {
        if interval_ns as f64 > LONG_SLOTS * (self.slots as i64 * self.slot_ns) as f64 {
            self.long[self.next_long] = (now, interval_ns);
            self.next_long = (self.next_long + 1) % LONG;
        }
        let mut longest = [0; MOST_BLINKS + 1];
        for &(_, interval_ns) in
            self.long.iter().filter(|(at, _)| at.0.saturating_add(LONG_WITHIN_NS) > now.0)
        {
            let place = longest.partition_point(|&longer| longer >= interval_ns);
            if place < longest.len() {
                longest[place..].rotate_right(1);
                longest[place] = interval_ns;
            }
        }
        let light_ns = (longest[MOST_BLINKS] + longest[MOST_BLINKS] / 4).min(LONGEST_LIGHT_NS);
        self.outlasted = (light_ns as u64).div_ceil(self.slot_ns as u64);
    }

    /// Frames were held back for another reason than time: an order, a session that begins, a projector that is gone.
    pub(crate) fn pause(&mut self) {
        (self.before, self.late, self.flicker) = (None, None, (0, 0));
        self.due_before = None;
        self.transfers_ns = [None; TRANSFERS];
        self.begin_window();
    }

    /// The device has reported how long a frame took to arrive, from its first packet to the whole.
    pub(crate) fn transferred(&mut self, transfer_ns: i64) {
        self.transfers_ns.rotate_left(1);
        self.transfers_ns[TRANSFERS - 1] = Some(transfer_ns);
        let Some(quickest) = self.quickest_transfer() else { return };
        if quickest < self.slots as f64 + SLOW_TRANSFER_SLOTS {
            return;
        }
        if self.sufficed.is_some() {
            self.trial_ns = (2 * self.trial_ns).min(LAST_TRIAL_NS);
        }
        self.needs(quickest);
        self.is_by_transfers = true;
    }

    /// The shortest time that one of the last frames took to arrive, slots; `None` before there are enough.
    fn quickest_transfer(&self) -> Option<f64> {
        let quicker = |least: i64, transfer_ns: &Option<i64>| transfer_ns.map(|ns| least.min(ns));
        self.transfers_ns.iter().try_fold(i64::MAX, quicker).map(|ns| ns as f64 / self.slot_ns as f64)
    }

    /// A frame got out at `now`.
    pub(crate) fn sent(&mut self, now: HostTime) {
        let Some(before) = self.before.replace(now) else { return };
        let interval_ns = now.ns_since(before).max(0);
        self.count += 1;
        self.sum_ns += interval_ns;
        self.longest_ns = self.longest_ns.max(interval_ns);
        if self.due_before.is_none() {
            // Nothing was reported of when light began. What was must not count twice.
            self.outlast(interval_ns, now);
        }
        if interval_ns > (self.steady_slots() as i64 + LIGHT_RESERVE_SLOTS) * self.slot_ns {
            self.flicker = (self.flicker.0 + 1, self.flicker.1 + interval_ns);
        } else {
            self.flicker = (0, 0);
        }
        if self.flicker.0 >= FLICKER {
            let mean = self.flicker.1 as f64 / (f64::from(self.flicker.0) * self.slot_ns as f64);
            self.needs(mean);
            return;
        }
        if self.count < FEWEST || self.sum_ns < WINDOW_NS {
            return;
        }
        let mean_ns = (self.sum_ns - self.longest_ns) as f64 / f64::from(self.count - 1);
        self.begin_window();
        self.judge(mean_ns / self.slot_ns as f64, now);
    }

    fn begin_window(&mut self) {
        (self.count, self.sum_ns, self.longest_ns) = (0, 0, 0);
    }

    /// Frames of a window came `mean` slots apart.
    fn judge(&mut self, mean: f64, now: HostTime) {
        if mean < self.slots as f64 + LATE_SLOTS {
            self.late = None;
            self.suffices(now);
            return;
        }
        let (windows, least) = self.late.map_or((1, mean), |(n, least)| (n + 1, least.min(mean)));
        self.late = Some((windows, least));
        let is_clear = self.sufficed.is_some() || least >= self.slots as f64 + VERY_LATE_SLOTS;
        if windows < if is_clear { AGREE_VERY_LATE } else { AGREE } {
            return;
        }
        match self.sufficed {
            Some(slots) => {
                self.trial_ns = (2 * self.trial_ns).min(LAST_TRIAL_NS);
                self.begin(slots);
            }
            None => self.needs(least),
        }
    }

    /// Frames need this many slots.
    fn needs(&mut self, mean: f64) {
        // What is out by a small part of a slot was late by chance.
        self.begin(((mean - LATE_SLOTS).ceil().max(1.0) as u64).clamp(self.slots + 1, MOST_SLOTS));
    }

    /// From now on each frame gets this many slots.
    fn begin(&mut self, slots: u64) {
        (self.slots, self.sufficed, self.since) = (slots, None, None);
        (self.late, self.flicker, self.is_by_transfers) = (None, (0, 0), false);
        self.begin_window();
    }

    /// After how long fewer slots are tried: soon where slow arrivals made them many, because arrivals show when they are quick
    /// again.
    fn trial_after_ns(&self) -> i64 {
        if self.is_by_transfers {
            WINDOW_NS
        } else {
            self.trial_ns
        }
    }

    /// The present number of slots suffices at `now`.
    fn suffices(&mut self, now: HostTime) {
        let since = *self.since.get_or_insert(now);
        if self.sufficed.is_some() && now.ns_since(since) >= WINDOW_NS {
            // Fewer do. The next trial follows at once, because after a stall many fewer may.
            (self.sufficed, self.trial_ns) = (None, FIRST_TRIAL_NS);
        } else if self.sufficed.is_some() || now.ns_since(since) < self.trial_after_ns() {
            return;
        }
        let fewer = self.slots - (self.slots / 4).max(1).min(self.slots - 1);
        let least = self.quickest_transfer().map_or(1, |slots| (slots - LATE_SLOTS).ceil().max(1.0) as u64);
        if fewer.max(least) < self.slots {
            self.sufficed = Some(self.slots);
            self.slots = fewer.max(least);
            self.since = None;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SLOT: i64 = 1_000_000;

    /// A link that needs `busy_ns(frame's instant)` for each frame and drops those that come while it is busy. Returns the
    /// slots per frame after each frame that was sent, with its instant.
    /// `waits`: those that come at most a slot too early wait.
    fn run(ms: i64, waits: bool, busy_ns: impl Fn(i64) -> i64) -> Vec<(i64, u64)> {
        let (mut cadence, mut next, mut free_at, mut all) = (Cadence::new(SLOT), 0, 0, Vec::new());
        while next < ms * SLOT {
            let sent = if waits && next > free_at - SLOT { next.max(free_at) } else { next };
            if sent >= free_at {
                free_at = sent + busy_ns(next);
                cadence.sent(HostTime(sent));
                all.push((next, cadence.slots()));
            }
            next += cadence.slots() as i64 * SLOT;
        }
        all
    }

    #[test]
    fn what_fits_its_slots_keeps_one_slot_a_frame() {
        // One frame in twenty is late, and there are stalls of 200 ms.
        let all = run(10_000, false, |ns| match ns / SLOT {
            k if k % 1000 == 400 => 200 * SLOT,
            k if k % 20 == 0 => SLOT * 3 / 2,
            _ => SLOT / 2,
        });
        assert!(all.iter().all(|&(_, slots)| slots == 1));
    }

    /// Whatever the link needs, each frame soon gets the slots in which it fits, for nearly all of the time.
    #[test]
    fn a_slow_link_settles_on_the_least_number_of_slots() {
        for (tenths, waits) in
            [13, 15, 19, 22, 37, 50, 126, 400].into_iter().flat_map(|t| [(t, false), (t, true)])
        {
            let all = run(60_000, waits, |_| tenths * SLOT / 10);
            let fits = (tenths as u64).div_ceil(10);
            let settled: Vec<_> = all.iter().filter(|(ns, _)| *ns > 8_000 * SLOT).collect();
            let at = |slots: u64| settled.iter().filter(|(_, s)| *s == slots).count() as f64;
            let share = at(fits) / settled.len() as f64;
            assert!(share > 0.9, "{tenths} tenths, {waits}: {fits} slots for {share} of the frames");
        }
    }

    /// Until the cadence is found, light flickers: that is for a tenth of a second where a link is very slow.
    #[test]
    fn what_flickers_gets_more_slots_at_once() {
        for busy in [5, 8, 13, 20] {
            let all = run(3_000, false, |_| busy * SLOT);
            let (ns, slots) = all[all.iter().position(|(_, slots)| *slots > 1).expect("it is slow")];
            assert!(slots == busy as u64 && ns <= 7 * busy * SLOT, "{busy}: {slots} slots after {ns} ns");
        }
    }

    #[test]
    fn a_link_that_is_quick_again_gets_a_frame_for_each_slot_again() {
        let all = run(20_000, false, |ns| if ns < 5_000 * SLOT { 12 * SLOT } else { SLOT / 2 });
        let back = all.iter().find(|(ns, slots)| *ns > 5_000 * SLOT && *slots == 1).expect("it comes back").0;
        assert!(back < 14_000 * SLOT, "after {} ms", back / SLOT - 5_000);
    }

    /// A device that reports how long frames took to arrive: a few of them decide, and what they exclude is not tried.
    #[test]
    fn reported_arrivals_decide_within_a_few_frames() {
        for tenths in [18, 37, 74, 126] {
            let fits = (tenths as u64).div_ceil(10);
            let (mut cadence, mut now, mut least) = (Cadence::new(SLOT), 0, u64::MAX);
            for frame in 0..3_000 {
                let interval = (cadence.slots() as i64 * SLOT).max(tenths * SLOT / 10);
                now += interval;
                cadence.sent(HostTime(now));
                cadence.transferred(tenths * SLOT / 10 + frame % 3);
                if frame > 4 {
                    least = least.min(cadence.slots());
                }
                assert!(cadence.slots() <= fits, "{tenths}: {} slots", cadence.slots());
            }
            assert_eq!(least, fits, "{tenths} tenths of a slot");
        }
    }

    /// A few slow frames are no slow link, and a link that was slow for a while gets all its slots back soon.
    #[test]
    fn arrivals_that_were_slow_for_a_while_cost_no_more_than_that() {
        let mut cadence = Cadence::new(SLOT);
        let mut now = 0;
        let mut step = |transfer_ns: i64, cadence: &mut Cadence| {
            now += (cadence.slots() as i64 * SLOT).max(transfer_ns);
            cadence.sent(HostTime(now));
            cadence.transferred(transfer_ns);
            now
        };
        for k in 0..2_000 {
            step(if k % 4 < 3 { 5 * SLOT } else { SLOT / 2 }, &mut cadence);
            if k < 20 {
                assert_eq!(cadence.slots(), 1);
            }
        }
        let mut cadence = Cadence::new(SLOT);
        (0..40).for_each(|_| _ = step(5 * SLOT, &mut cadence));
        assert_eq!(cadence.slots(), 5);
        let begin = step(SLOT / 2, &mut cadence);
        let mut end = begin;
        while cadence.slots() > 1 {
            end = step(SLOT / 2, &mut cadence);
        }
        assert!(end - begin < 2_500 * SLOT, "{} ms", (end - begin) / SLOT);
    }

    /// Whatever the intervals are: light that lasts for the slots of a frame goes out twice in three seconds at most, but for the
    /// first frames, and what was long is forgotten after that time.
    #[test]
    fn light_outlasts_nearly_all_intervals() {
        let mut cadence = Cadence::new(SLOT);
        let (mut now, mut dark_at, mut seed) = (0i64, Vec::<i64>::new(), 1u64);
        while now < 20_000 * SLOT {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            // Intervals of 5 to 45 slots; none is alike.
            let interval = 5 * SLOT + (seed >> 33) as i64 % (40 * SLOT);
            let light = cadence.light_slots() as i64 * SLOT;
            now += interval;
            cadence.sent(HostTime(now));
            if interval > light && now > 500 * SLOT {
                dark_at.push(now);
            }
        }
        assert!(dark_at.windows(3).all(|w| w[2] - w[0] > 3_000 * SLOT), "{dark_at:?}");
        let end = now + 3_100 * SLOT;
        while now < end {
            now += cadence.slots() as i64 * SLOT;
            cadence.sent(HostTime(now));
        }
        assert_eq!(cadence.outlasted, 0);
    }

    /// One stall, however long, makes no light last longer, whether the device reports of its light or not.
    #[test]
    fn one_stall_decides_nothing_about_light() {
        for reports in [false, true] {
            let mut cadence = Cadence::new(SLOT);
            let mut now = 0;
            for frame in 0..2_000 {
                now += if frame == 1_000 { 200 * SLOT } else { SLOT };
                cadence.sent(HostTime(now));
                if reports {
                    cadence.lit([HostTime(now + SLOT), HostTime(now + SLOT)]);
                }
                assert_eq!(cadence.light_slots(), 1, "{reports}, frame {frame}");
            }
        }
    }

    #[test]
    fn a_pause_is_no_cadence() {
        let mut cadence = Cadence::new(SLOT);
        for k in 0..1000 {
            cadence.sent(HostTime(k * 50 * SLOT));
            cadence.pause();
        }
        assert_eq!(cadence.slots(), 1);
    }
}
