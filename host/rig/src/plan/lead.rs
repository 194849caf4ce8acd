//! Learns from measured times how early a frame must begin, and when its slot must be given up.
//!
//! The measured time is that from the instant at which a frame should have been latched to the instant at which the
//! device had it whole. The lead is chosen so that one frame in two hundred has at least [`MARGIN_NS`] of slack left,
//! and one in a thousand at least some, without a frame having to be late first.
//!
//! The estimator keeps histograms of the last two spans of time: quantiles over the last seconds. Where the frames are
//! too few for a quantile, it is not replaced by their longest time, which would make an outlier the rule: the tail
//! beyond the quantile that they do determine is continued as an exponential one, with a scale that the frames
//! determine, widened by its own uncertainty, and no further than the share that so many frames can show.
//!
//! A tail is single frames. Where all frames of a row need more than the lead, the machine itself has become slower:
//! another program streams through the caches, for example. Then only the frames from there on count, and what was
//! known before comes back with the first row that needs no more than before. Else one slow fifth of a second would
//! lengthen the lead until both spans are over. If it becomes slow again within a span, that is no accident any more,
//! and the frames of both count together.
//!
//! Bins are a 64th of a slot wide up to four slots. From there on each is a 33rd wider than the one before: a
//! renderer that needs many slots for a frame also needs a lead, and its frames are planned for slots that they can
//! meet.

/// Bins of equal width, each a 64th of a slot.
const EVEN_BINS: usize = 256;
/// Slots that the even bins span.
const EVEN_SLOTS: i64 = 4;
/// Bins beyond them, each longer by [`GROWTH`]: 4 slots times 1.03^256 are about 7,700 slots.
const WIDE_BINS: usize = 256;
/// All bins.
const BINS: usize = EVEN_BINS + WIDE_BINS;
/// Upper edge of a wide bin divided by its lower edge.
const GROWTH: f64 = 1.03;
/// A time longer than this many typical times (and than [`EVEN_SLOTS`]) was not work but a stall, and no lead helps
/// against a stall ...
const STALL_TIMES: i64 = 4;
/// ... unless this many occur in a row: then the work itself has become that long.
const STALLS_IN_A_ROW: u32 = 8;
/// A span lasts for about this many nanoseconds ...
const SPAN_NS: i64 = 8_000_000_000;
/// ... but has no more frames than this, and no fewer than [`FEWEST_IN_A_SPAN`].
const MOST_IN_A_SPAN: u32 = 2048;
const FEWEST_IN_A_SPAN: u32 = 64;
/// Slack that is left to the frame of [`LATE_SHARE`], nanoseconds.
const MARGIN_NS: i64 = 150_000;
/// Share of frames that may have less slack than [`MARGIN_NS`].
const LATE_SHARE: f64 = 0.005;
/// Share of frames that may have none.
const LOST_SHARE: f64 = 0.001;
/// Share of frames that take longer than what decides when a slot is given up.
const UNUSUAL_SHARE: f64 = 0.1;
/// A quantile counts as determined by the frames if so many of them lie beyond it.
const BEYOND: f64 = 8.0;
/// The quantile from which the tail begins at the latest, as the share beyond it.
const TAIL_SHARE: f64 = 0.2;
/// With fewer frames than this the first guess also counts.
const FEW: u32 = 16;
/// A row of frames that decides whether the machine has become slower or is as before lasts this long, nanoseconds ...
const ROW_NS: i64 = 32_000_000;
/// ... but has no more frames than this, and no fewer than [`FEWEST_IN_A_ROW`].
const MOST_IN_A_ROW: usize = 32;
const FEWEST_IN_A_ROW: usize = 8;

/// Frames by the time that they needed, of this span and of the one before.
#[derive(Clone, Debug)]
struct Spans {
    bins: [[u32; BINS]; 2],
    /// Frames of both.
    totals: [u32; 2],
}

impl Spans {
    const EMPTY: Self = Self { bins: [[0; BINS]; 2], totals: [0; 2] };

    /// A frame that lies in `bin`. Whole spans of `most` frames are forgotten: counts that are halved lose their single events
    /// first, and these are the tail.
    fn add(&mut self, bin: usize, most: i64) {
        self.bins[0][bin] += 1;
        self.totals[0] += 1;
        if i64::from(self.totals[0]) >= most {
            self.bins[1] = std::mem::replace(&mut self.bins[0], [0; BINS]);
            self.totals[1] = std::mem::take(&mut self.totals[0]);
        }
    }

    fn join(&mut self, other: &Self) {
        for (mine, theirs) in self.bins.iter_mut().flatten().zip(other.bins.iter().flatten()) {
            *mine += theirs;
        }
        self.totals = [0, 1].map(|k| self.totals[k] + other.totals[k]);
    }
}

/// How the frames compare with those before.
#[derive(Clone, Copy, Debug)]
enum FramePace {
    Usual,
    /// So many frames in a row needed more than what was the lead before them, nanoseconds.
    Rises {
        lead_ns: i64,
        row: usize,
    },
    /// All of a row did. `row`: frames in a row that need no more than before again; `frames`: all since then.
    Slower {
        lead_ns: i64,
        row: usize,
        frames: u32,
    },
}

/// Quantiles of the time that frames need.
#[derive(Clone, Debug)]
pub struct LeadEstimator {
    spans: Spans,
    pace: FramePace,
    /// What was known before the machine became slower, and the bins of the frames that showed it.
    before: Spans,
    row: [usize; MOST_IN_A_ROW],
    /// Frames in a row that decide, and frames since the machine was slower last.
    row_len: usize,
    since_slower: u32,
    /// Upper edges of the bins, nanoseconds.
    edges: [i64; BINS],
    slot_ns: i64,
    first_guess_ns: i64,
    longest_wait_ns: i64,
    stalls: u64,
    stalls_in_a_row: u32,
}

impl LeadEstimator {
    /// For slots of `slot_ns` > 0. `first_guess_ns` is the lead until enough frames are measured. The lead exceeds the
    /// time of a typical frame by at most `longest_wait_ns`; a frame sent earlier would find no room in the device.
    pub fn new(slot_ns: i64, first_guess_ns: i64, longest_wait_ns: i64) -> Self {
        let slot_ns = slot_ns.max(1);
        let bin_ns = (slot_ns * EVEN_SLOTS / EVEN_BINS as i64).max(1);
        let mut edges = [0; BINS];
        for (i, edge) in edges.iter_mut().enumerate() {
            *edge = match i.checked_sub(EVEN_BINS) {
                None => (i as i64 + 1) * bin_ns,
                Some(wide) => ((EVEN_BINS as i64 * bin_ns) as f64 * GROWTH.powi(wide as i32 + 1)) as i64,
            };
        }
        Self {
            spans: Spans::EMPTY,
            pace: FramePace::Usual,
            before: Spans::EMPTY,
            row: [0; MOST_IN_A_ROW],
            row_len: ((ROW_NS / slot_ns) as usize).clamp(FEWEST_IN_A_ROW, MOST_IN_A_ROW),
            since_slower: u32::MAX,
            edges,
            slot_ns,
            first_guess_ns: first_guess_ns.max(0),
            longest_wait_ns: longest_wait_ns.max(0),
            stalls: 0,
            stalls_in_a_row: 0,
        }
    }

    /// Records the time of one frame from the instant at which it should have been latched until the device had it
    /// whole, nanoseconds.
    pub fn measured(&mut self, needed_ns: i64) {
        let needed_ns = needed_ns.max(0);
        let usual = (self.slot_ns * EVEN_SLOTS).max(self.typical_ns().saturating_mul(STALL_TIMES));
        if needed_ns >= usual {
            self.stalls += 1;
            self.stalls_in_a_row += 1;
            if self.stalls_in_a_row < STALLS_IN_A_ROW {
                return;
            }
        } else {
            self.stalls_in_a_row = 0;
        }
        let bin = self.edges.partition_point(|&edge| edge <= needed_ns);
        if bin >= BINS {
            return;
        }
        let frame_ns = self.typical_ns().max(self.slot_ns);
        let most = (SPAN_NS / frame_ns).clamp(FEWEST_IN_A_SPAN.into(), MOST_IN_A_SPAN.into());
        self.compare(needed_ns, bin, most);
        self.spans.add(bin, most);
    }

    /// Compares a frame with those before it, and decides of which frames the lead is made.
    fn compare(&mut self, needed_ns: i64, bin: usize, most: i64) {
        self.since_slower = self.since_slower.saturating_add(1);
        let row_len = self.row_len;
        self.pace = match self.pace {
            FramePace::Usual if self.total() >= FEW && needed_ns > self.lead_ns() => {
                self.before.clone_from(&self.spans);
                self.row[0] = bin;
                FramePace::Rises { lead_ns: self.lead_ns(), row: 1 }
            }
            FramePace::Rises { lead_ns, row } if needed_ns > lead_ns && row < row_len => {
                self.row[row] = bin;
                FramePace::Rises { lead_ns, row: row + 1 }
            }
            FramePace::Rises { lead_ns, .. } if needed_ns > lead_ns => {
                self.spans = Spans::EMPTY;
                self.row[..row_len].iter().for_each(|bin| self.spans.add(*bin, most));
                FramePace::Slower { lead_ns, row: 0, frames: 0 }
            }
            FramePace::Usual | FramePace::Rises { .. } => FramePace::Usual,
            // It is the rule now.
            FramePace::Slower { frames, .. } if i64::from(frames) >= most => FramePace::Usual,
            FramePace::Slower { lead_ns, row, .. } if needed_ns <= lead_ns && row + 1 >= row_len => {
                if i64::from(self.since_slower) >= most {
                    self.spans.clone_from(&self.before);
                } else {
                    self.spans.join(&self.before);
                }
                self.since_slower = 0;
                FramePace::Usual
            }
            FramePace::Slower { lead_ns, row, frames } => {
                let row = if needed_ns <= lead_ns { row + 1 } else { 0 };
                FramePace::Slower { lead_ns, row, frames: frames + 1 }
            }
        };
    }

    /// Frames that are remembered.
    fn total(&self) -> u32 {
        self.spans.totals[0] + self.spans.totals[1]
    }

    /// How long before its slot a frame is latched so that nearly all are whole in time.
    pub fn lead_ns(&self) -> i64 {
        let measured = self.beyond(LOST_SHARE).max(self.beyond(LATE_SHARE).saturating_add(MARGIN_NS));
        let lead = if self.total() < FEW { measured.max(self.first_guess_ns) } else { measured };
        lead.min(self.needed_ns().saturating_add(self.longest_wait_ns))
    }

    /// The time that most frames need; the first guess while nothing has been measured.
    fn needed_ns(&self) -> i64 {
        if self.total() == 0 {
            self.first_guess_ns
        } else {
            self.quantile(UNUSUAL_SHARE)
        }
    }

    /// The time that most frames need: a slot that begins earlier than this from now is given up for the next one.
    pub fn typical_ns(&self) -> i64 {
        self.needed_ns().min(self.lead_ns())
    }

    /// Frames that took so long that no lead could have helped.
    #[cfg(test)]
    pub(crate) fn stalls(&self) -> u64 {
        self.stalls
    }

    /// The time that a frame exceeds with probability `share`, nanoseconds: a quantile where the frames determine it,
    /// else by an exponential tail; 0 without measurements.
    fn beyond(&self, share: f64) -> i64 {
        let frames = f64::from(self.total());
        // So many frames can show no smaller share.
        let share = share.max(1.0 / frames.max(1.0));
        if frames * share >= BEYOND {
            return self.quantile(share);
        }
        // The median of few frames and what a fifth of them exceed are known well enough; of more frames also what
        // fewer of them exceed.
        let from = (BEYOND / frames.max(1.0)).min(TAIL_SHARE);
        let (median, known) = (self.quantile(0.5), self.quantile(from));
        // An exponential tail falls by this much from the half to `from`. Its scale is measured by the frames beyond
        // the median, and is wrong by one over the square root of their number.
        let scale = (known - median) as f64 / (0.5 / from).ln();
        let widened = scale * (1.0 + 1.0 / (frames * 0.5).max(1.0).sqrt());
        known.saturating_add((widened * (from / share).ln()).max(0.0) as i64)
    }

    /// The least upper edge of a bin that at most the share `beyond` of all frames exceeds, nanoseconds; 0 without
    /// measurements.
    fn quantile(&self, beyond: f64) -> i64 {
        let most = (f64::from(self.total()) * beyond).floor() as u32;
        let mut rest = self.total();
        for (edge, (new, old)) in self.edges.iter().zip(self.spans.bins[0].iter().zip(&self.spans.bins[1])) {
            let n = new + old;
            rest -= n;
            if n > 0 && rest <= most {
                return *edge;
            }
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SLOT: i64 = 1_055_966;

    fn estimator() -> LeadEstimator {
        LeadEstimator::new(SLOT, 2 * SLOT, 4 * SLOT)
    }

    /// A reproducible number between 0 and 1.
    fn noise(i: u64) -> f64 {
        (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 11) as f64 / (1u64 << 53) as f64
    }

    #[test]
    fn the_first_guess_gives_way_to_what_is_measured() {
        let mut e = estimator();
        assert_eq!(e.lead_ns(), 2 * SLOT);
        for i in 0..FEW {
            e.measured(300_000 + i64::from(i));
        }
        assert!((450_000..500_000).contains(&e.lead_ns()), "{}", e.lead_ns());
        assert!(e.typical_ns() <= e.lead_ns() && e.typical_ns() >= 300_000);
    }

    /// A time that exceeds 0.3 ms by an exponential amount of a mean of 0.1 ms.
    fn exponential(i: u64) -> i64 {
        300_000 + (-100_000.0 * (1.0 - noise(i)).ln()) as i64
    }

    /// A time around 0.4 ms with few that are far longer: one in a hundred takes up to three times as long.
    fn with_outliers(i: u64) -> i64 {
        let usual = 350_000 + (100_000.0 * noise(i)) as i64;
        if noise(i ^ 0x5555_0000) < 0.01 {
            usual + (800_000.0 * noise(i ^ 0x3333_0000)) as i64
        } else {
            usual
        }
    }

    /// At any steady load one frame in two hundred has at least the margin left, and one in a thousand something; and
    /// the lead is no longer than that needs.
    #[test]
    fn the_lead_leaves_what_it_promises() {
        for needs in [exponential, with_outliers, |i| (200_000.0 + 600_000.0 * noise(i).powi(4)) as i64] {
            let mut e = estimator();
            (0..20_000).for_each(|i| e.measured(needs(i)));
            let lead = e.lead_ns();
            let mut all: Vec<i64> = (20_000..60_000).map(needs).collect();
            all.sort_unstable();
            let [q995, q999] = [0.995, 0.999].map(|q| all[(q * all.len() as f64) as usize]);
            let ideal = q999.max(q995 + MARGIN_NS);
            let off = lead - ideal;
            assert!((-60_000..160_000).contains(&off), "{lead} ns, where {ideal} ns would do");
            let slow = all.iter().filter(|&&ns| ns > e.typical_ns()).count();
            assert!(
                slow <= all.len() / 9,
                "{slow} of {} beyond the typical {} ns",
                all.len(),
                e.typical_ns()
            );
        }
    }

    /// Few frames widen the lead by what they leave open, and no single one makes it its own: the longest of 32 frames
    /// may be ten times as long as all others without moving the lead by as much.
    #[test]
    fn few_frames_are_judged_by_their_spread_and_not_by_the_longest() {
        for frames in [16u64, 32, 64, 128, 256] {
            // What one frame in so many exceeds, and the margin: less cannot be known of them.
            let ideal = 450_000 + (100_000.0 * (frames as f64).ln()) as i64;
            let leads: Vec<i64> = (0..200)
                .map(|run| {
                    let mut e = estimator();
                    (0..frames).for_each(|i| e.measured(exponential(7_919 * run + i)));
                    e.lead_ns()
                })
                .collect();
            let short = leads.iter().filter(|&&lead| lead < ideal - 250_000).count();
            let mean = leads.iter().sum::<i64>() / leads.len() as i64;
            assert!(short <= 40, "{frames} frames: {short} of 200 leads are far too short");
            assert!(
                (ideal - 150_000..ideal + 450_000).contains(&mean),
                "{frames} frames: {mean}, not {ideal}"
            );
        }
        let mut e = estimator();
        (0..32).for_each(|i| e.measured(exponential(i)));
        let before = e.lead_ns();
        e.measured(3_900_000);
        assert!(e.lead_ns() < before + 300_000, "{before} ns, then {} ns", e.lead_ns());
    }

    #[test]
    fn the_lead_ends_where_the_device_has_no_room() {
        let mut e = LeadEstimator::new(SLOT, 0, SLOT / 4);
        for i in 0..10_000u64 {
            e.measured(if i % 50 == 0 { 3_000_000 } else { 400_000 });
        }
        let lead = e.lead_ns();
        assert!((400_000 + SLOT / 4..450_000 + SLOT / 4).contains(&lead), "{lead}");
    }

    #[test]
    fn a_stall_changes_nothing() {
        let mut e = estimator();
        for i in 0..5_000 {
            e.measured(300_000 + (noise(i) * 1e5) as i64);
        }
        let before = (e.lead_ns(), e.typical_ns());
        // 100 ms: the frame in progress and those behind it.
        for waiting in [100_000_000, 99_000_000, 98_000_000] {
            e.measured(waiting);
        }
        assert_eq!(((e.lead_ns(), e.typical_ns()), e.stalls()), (before, 3));
    }

    /// The lead follows a rising load within a second and forgets a past load within some seconds.
    #[test]
    fn a_changed_load_is_followed() {
        let mut e = estimator();
        let feed = |e: &mut LeadEstimator, n: u64, ns: i64| (0..n).for_each(|_| e.measured(ns));
        feed(&mut e, 10_000, 300_000);
        assert!(e.lead_ns() < 550_000);
        feed(&mut e, 10, 1_500_000);
        assert!(e.lead_ns() >= 1_500_000, "{}", e.lead_ns());
        feed(&mut e, 15_000, 300_000);
        assert!(e.lead_ns() < 550_000, "{}", e.lead_ns());
    }

    /// Memory that is slow for a fifth of a second, and then as before: the lead follows it there and back.
    #[test]
    fn a_slow_moment_is_over_when_it_is_over() {
        for slot in [SLOT, 4 * SLOT, 16 * SLOT] {
            let mut e = LeadEstimator::new(slot, 2 * slot, 4 * slot);
            (0..5_000).for_each(|i| e.measured(exponential(i)));
            let before = e.lead_ns();
            let frames = (200_000_000 / slot) as u64;
            (0..frames).for_each(|i| e.measured(4 * exponential(i)));
            assert!(e.lead_ns() > before + 800_000, "{} ns for needs of 1.6 ms", e.lead_ns());
            // Half a second.
            (0..frames * 5 / 2).for_each(|i| e.measured(exponential(i)));
            assert!((e.lead_ns() - before).abs() < 60_000, "{before} ns, then {} ns", e.lead_ns());
        }
    }

    /// What is slow again and again is no accident: the lead remembers it.
    #[test]
    fn slow_moments_that_return_count() {
        let mut e = estimator();
        (0..5_000).for_each(|i| e.measured(exponential(i)));
        for _ in 0..3 {
            (0..100).for_each(|i| e.measured(4 * exponential(i)));
            (0..900).for_each(|i| e.measured(exponential(i)));
        }
        assert!(e.lead_ns() > 1_600_000, "{}", e.lead_ns());
    }

    /// A machine that stays slower is followed within a row, and its lead is that of the new frames alone.
    #[test]
    fn what_becomes_slower_and_stays_is_followed() {
        let mut e = estimator();
        (0..5_000).for_each(|i| e.measured(exponential(i)));
        (0..20_000).for_each(|i| e.measured(1_000_000 + exponential(i)));
        let slow = e.lead_ns();
        let mut alone = estimator();
        (0..20_000).for_each(|i| alone.measured(1_000_000 + exponential(i)));
        assert!((slow - alone.lead_ns()).abs() < 60_000, "{slow} and {} ns", alone.lead_ns());
    }

    /// Found in use, R21: a renderer that needs many slots for a frame gets a lead that it can keep, from its first
    /// frames on.
    #[test]
    fn a_renderer_slower_than_its_slots_has_a_lead_that_it_can_keep() {
        let slot = 16_666_667;
        let mut e = LeadEstimator::new(slot, 2_270_000, 2 * slot);
        let needs = |i: u64| 60_000_000 + (noise(i) * 12e6) as i64;
        for i in 0..STALLS_IN_A_ROW as u64 + 32 {
            e.measured(needs(i));
        }
        let late = (1000..2000).filter(|&i| needs(i) > e.lead_ns()).count();
        assert!(late <= 30, "{late} of 1000 beyond a lead of {} ns", e.lead_ns());
        assert!(e.lead_ns() < 85_000_000, "{} ns for needs of at most 72 ms", e.lead_ns());
        // Faster again: the old times are forgotten within half a minute at 60 frames per second.
        for _ in 0..1800 {
            e.measured(10_000_000);
        }
        assert!(e.lead_ns() < 13_000_000, "{} ns for needs of 10 ms", e.lead_ns());
    }

    proptest! {
        #[test]
        fn any_measurement_leaves_it_in_bounds(ns in prop::collection::vec(any::<i64>(), 0..600)) {
            let mut e = estimator();
            for ns in ns {
                e.measured(ns);
                prop_assert!(e.lead_ns() >= 0);
                prop_assert!((0..=e.lead_ns()).contains(&e.typical_ns()));
            }
        }
    }
}
