//! Samples into pairs: which frames they are, and how much of each was lit, at several instants of a frame.
//!
//! A display's light comes some frames after the instant that its driver tells, and nobody knows how many. The lag is
//! found from the light: at the right one, pairs with the same stripes have differences of the same sign from round to
//! round, once each is taken with the sign of its identity; at any other lag, half of them do. While the wand moves, half
//! of them do at the right one, too: what counts is that more do than could by chance.

use super::super::decode::DecodeError;
use super::super::Timing;
use super::code::InverseCode;
use super::record::{Mapped, Record};
use crate::projector::percentile;

/// Most instants of a frame at which light is compared.
pub(super) const TICKS: usize = 8;
/// A frame has an instant for each of so many nanoseconds.
const TICK_NS: f64 = 2e6;
/// Lags that are tried, nanoseconds: a display may be a quarter of a second late.
const LAGS_NS: [f64; 2] = [-40e6, 300e6];
/// The lag is found to within this, nanoseconds: it is a part of the latency.
const LAG_STEP_NS: f64 = 2e3;
/// Share of an instant's time at either end that is left out: clocks are known to a tenth of a millisecond.
const GUARD: f64 = 0.1;
/// Light of an instant of the frame counts if it reaches this share of the brightest one's.
const LEAST_LIGHT: f64 = 0.25;
/// A pair counts when its contrast reaches this share of the usual one.
const LEAST_CONTRAST: f64 = 0.15;
/// A level is not more than so far outside 0 to 1.
const MOST_BEYOND: f64 = 0.25;
/// Fewest pairs.
const FEWEST: usize = 60;
/// Pairs of a hundred that agree if there is no doubt.
const SURE_PERCENT: f64 = 80.0;
/// Agreement over its standard deviation if the signs were random. Of some thousand lags the best one reaches four by chance.
const LEAST_SIGNIFICANCE: f64 = 7.0;

/// How well pairs agree with those of the next round.
#[derive(Clone, Copy, Debug, Default)]
struct Agreement {
    /// Sum of the products of two differences.
    sum: f64,
    /// Sum of their sizes.
    size: f64,
    /// Sum of their squares.
    squares: f64,
}

impl Agreement {
    /// Of a hundred pairs, weighted by their light.
    fn percent(&self) -> f64 {
        50.0 + 50.0 * self.sum / self.size.max(f64::MIN_POSITIVE)
    }

    /// Whether it is no chance.
    fn is_sure(&self) -> bool {
        self.percent() >= SURE_PERCENT || self.sum >= LEAST_SIGNIFICANCE * self.squares.sqrt()
    }
}

/// A pair as the sensor saw it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Its number.
    pub number: u64,
    /// When the frame with the stripes began, and the one with the inverse, by the host's clock less the lag.
    pub begins_ns: [i64; 2],
    /// Share of the stripes' light at each instant, the mean of both frames: 0 to 1. `None` where there is no light.
    pub levels: [Option<f64>; TICKS],
    /// Stripes less inverse where all is lit, in the sensor's unit.
    pub contrast: f64,
}

impl Pair {
    /// The mean level.
    pub fn level(&self) -> f64 {
        let (sum, count) =
            self.levels.iter().flatten().fold((0.0, 0.0), |(s, n), level| (s + level, n + 1.0));
        sum / f64::max(count, 1.0)
    }
}

/// What the samples say.
#[derive(Clone, Debug)]
pub struct DecodedPairs {
    /// Pairs that are whole and lit, in order.
    pub pairs: Vec<Pair>,
    /// Pairs during which the sensor was covered, or outside the picture.
    pub dropped: usize,
    /// Share of the slots with a picture of its own, 0 to 1: on a busy machine others repeat the picture before.
    pub carried: f64,
    /// How much later than told the light came, nanoseconds.
    pub lag_ns: f64,
    /// Pairs of a hundred whose sign agrees with that of their stripes in the next round.
    pub identity_percent: f64,
    /// When light came at each instant of a frame, nanoseconds after its begin.
    pub instants_ns: [f64; TICKS],
    /// Length of a frame, nanoseconds.
    pub frame_ns: f64,
}

/// How a projector's light lies in a frame.
#[derive(Clone, Copy, Debug)]
pub enum FrameLight<'a> {
    /// Evenly, as a display holds a picture.
    Held,
    /// In equal parts of the frame, each as bright as its number says.
    Planes(&'a [f64]),
}

impl FrameLight<'_> {
    /// Where the brightest light lies in one piece, as shares of the frame: its ends are seen best.
    fn brightest(&self) -> [f64; 2] {
        let Self::Planes(parts) = self else { return [0.0, 1.0] };
        let most = parts.iter().copied().fold(0.0, f64::max);
        let first = parts.iter().position(|p| *p >= most).unwrap_or(0);
        let count = parts[first..].iter().take_while(|p| **p >= most).count();
        [first, first + count].map(|i| i as f64 / parts.len().max(1) as f64)
    }

    /// The middle of the light between two shares of a frame, as a share of the frame.
    fn middle(&self, from: f64, until: f64) -> f64 {
        let Self::Planes(parts) = self else { return 0.5 * (from + until) };
        let count = parts.len() as f64;
        let within = |i: usize| {
            let (low, high) = ((i as f64 / count).max(from), ((i + 1) as f64 / count).min(until));
            (0.5 * (low + high), (high - low).max(0.0) * parts[i])
        };
        let (sum, light) =
            (0..parts.len()).map(within).fold((0.0, 0.0), |(s, l), (at, w)| (s + at * w, l + w));
        if light > 0.0 {
            sum / light
        } else {
            0.5 * (from + until)
        }
    }
}

/// When the two frames of a pair began by the projector's report, nanoseconds after the first sample.
#[derive(Clone, Copy)]
struct PairStarts {
    pair: u64,
    begins_ns: [f64; 2],
}

/// Decodes a recording. `light` is that of a white frame; `shown` tells which frame's picture each slot showed: the slot's own, unless that frame was late or
/// never came.
///
/// # Errors
/// [`DecodeError::NoSamples`], [`DecodeError::NotFinite`], [`DecodeError::NoLight`], and [`DecodeError::NoIdentity`] where
/// the samples are not those of the code.
pub fn decode_pairs(
    code: &InverseCode,
    (timing, light): (&Timing, FrameLight<'_>),
    blocks: &[Mapped],
    shown: &dyn Fn(u64) -> u64,
) -> Result<DecodedPairs, DecodeError> {
    if let Some(bad) = blocks.iter().position(|(b, _)| !b.levels.iter().all(|l| l.is_finite())) {
        return Err(DecodeError::NotFinite(bad));
    }
    let record = Record::new(blocks).ok_or(DecodeError::NoSamples)?;
    let (pairs, carried) = shown_pairs(timing, &record, shown);
    let brightest = light.brightest();
    let search = LagSearch { code, record: &record, pairs: &pairs, frame_ns: timing.frame_ns, brightest };
    let (lag_ns, identity_percent) = search.lag()?;
    let ticks = ((timing.frame_ns / TICK_NS).round() as usize).clamp(2, TICKS);
    let raw: Vec<(PairStarts, [Option<f64>; TICKS])> =
        pairs.iter().map(|p| (*p, search.differences(p, lag_ns, ticks))).collect();
    let (levels, dropped) = levels(code, &record, &raw);
    let instants_ns = std::array::from_fn(|i| {
        let [from, until] = within_tick(i).map(|t| t / ticks as f64);
        light.middle(from, until) * timing.frame_ns
    });
    Ok(DecodedPairs {
        pairs: levels,
        dropped,
        carried,
        lag_ns,
        identity_percent,
        instants_ns,
        frame_ns: timing.frame_ns,
    })
}

/// The part of an instant's time that is looked at, in ticks from the frame's begin.
fn within_tick(tick: usize) -> [f64; 2] {
    [tick as f64 + GUARD, tick as f64 + 1.0 - GUARD]
}

/// The pairs of which both frames were shown, with the first slot of each, and the share of the slots with a picture of its own.
fn shown_pairs(timing: &Timing, record: &Record, shown: &dyn Fn(u64) -> u64) -> (Vec<PairStarts>, f64) {
    let begin = (record.base_ns.saturating_sub(timing.frame_zero_ns)) as f64;
    let slot = |ns: f64| ((begin + ns) / timing.frame_ns).max(0.0) as u64;
    let slots = slot(-LAGS_NS[1])..slot(record.length_ns() - LAGS_NS[0]);
    let count = slots.end.saturating_sub(slots.start);
    let mut before = None;
    let fresh: Vec<(u64, u64)> = slots
        .filter_map(|slot| {
            let frame = shown(slot);
            (before.replace(frame) != Some(frame)).then_some((frame, slot))
        })
        .collect();
    let of_slot = |slot: u64| slot as f64 * timing.frame_ns - begin;
    let pair = |w: &[(u64, u64)]| {
        let [(first, a), (second, b)] = [w[0], w[1]];
        (first % 2 == 0 && second == first + 1 && b - a <= 4)
            .then(|| PairStarts { pair: first / 2, begins_ns: [of_slot(a), of_slot(b)] })
    };
    let carried = fresh.len() as f64 / count.max(1) as f64;
    (fresh.windows(2).filter_map(pair).collect(), carried)
}

struct LagSearch<'a> {
    code: &'a InverseCode,
    record: &'a Record,
    pairs: &'a [PairStarts],
    frame_ns: f64,
    /// The part of a frame by which the lag is found.
    brightest: [f64; 2],
}

impl LagSearch<'_> {
    /// First frame less second one, with the sign of the identity: stripes less inverse.
    fn difference(&self, pair: &PairStarts, from_ns: f64, until_ns: f64) -> Option<f64> {
        let [a, b] = pair.begins_ns.map(|begin| self.record.mean(begin + from_ns, begin + until_ns));
        let difference = a? - b?;
        Some(if self.code.is_inverse(2 * pair.pair) { -difference } else { difference })
    }

    /// The differences of pairs in one round times those in the next.
    fn agreement(&self, lag_ns: f64) -> Agreement {
        let [from, until] = self.brightest.map(|share| lag_ns + share * self.frame_ns);
        let all: Vec<Option<f64>> = self.pairs.iter().map(|p| self.difference(p, from, until)).collect();
        let round = self.code.pairs() as u64;
        let mut next = 0;
        let mut found = Agreement::default();
        for (pair, now) in self.pairs.iter().zip(&all) {
            while self.pairs.get(next).is_some_and(|p| p.pair < pair.pair + round) {
                next += 1;
            }
            let is_same = self.pairs.get(next).is_some_and(|p| p.pair == pair.pair + round);
            let later = all.get(next).copied().flatten().filter(|_| is_same);
            if let Some(product) = now.zip(later).map(|(a, b)| a * b) {
                found.sum += product;
                found.size += product.abs();
                found.squares += product * product;
            }
        }
        found
    }

    /// The lag, and the agreement at it, percent.
    fn lag(&self) -> Result<(f64, f64), DecodeError> {
        let lag = self.best_lag();
        let found = self.agreement(lag);
        if found.size <= 0.0 {
            return Err(DecodeError::NoLight);
        }
        let percent = found.percent();
        if self.pairs.len() < FEWEST || !found.is_sure() {
            return Err(DecodeError::NoIdentity { percent });
        }
        Ok((lag, percent))
    }

    /// The lag at which the rounds agree best.
    fn best_lag(&self) -> f64 {
        let best = |from: f64, until: f64, step: f64| {
            let count = ((until - from) / step) as usize + 1;
            let all = (0..count).map(|i| from + i as f64 * step);
            let scored = all.map(|lag| (self.agreement(lag).sum, lag));
            scored.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(0.0, |(_, lag)| lag)
        };
        let [from, until] = self.brightest;
        let coarse = (until - from) * self.frame_ns / 6.0;
        let mut lag = best(LAGS_NS[0], LAGS_NS[1], coarse);
        let mut step = coarse;
        while step > LAG_STEP_NS {
            (lag, step) = (best(lag - step, lag + step, 0.25 * step), 0.25 * step);
        }
        lag
    }

    /// Stripes less inverse at each instant of the frame.
    fn differences(&self, pair: &PairStarts, lag_ns: f64, ticks: usize) -> [Option<f64>; TICKS] {
        let tick = self.frame_ns / ticks as f64;
        std::array::from_fn(|i| {
            let [from, until] = within_tick(i).map(|t| lag_ns + t * tick);
            let seen = || self.difference(pair, from, until);
            (i < ticks).then(seen).flatten()
        })
    }
}

/// Differences into levels: over the light of the instant within a frame, and over the contrast around the pair.
fn levels(
    code: &InverseCode,
    record: &Record,
    raw: &[(PairStarts, [Option<f64>; TICKS])],
) -> (Vec<Pair>, usize) {
    let is_wide = |pair: u64| code.is_wide(&code.stripe(code.index(pair)));
    let wide: Vec<&(PairStarts, [Option<f64>; TICKS])> =
        raw.iter().filter(|(s, _)| is_wide(s.pair)).collect();
    let size = |i: usize| {
        let all = wide.iter().filter_map(|(_, d)| d[i].map(f64::abs));
        percentile(all.collect(), 0.7)
    };
    let sizes: [f64; TICKS] = std::array::from_fn(size);
    let brightest = sizes.iter().copied().fold(1e-12, f64::max);
    let light = sizes.map(|s| (s >= LEAST_LIGHT * brightest).then_some(s / brightest));
    let over_light = |d: &[Option<f64>; TICKS]| -> [Option<f64>; TICKS] {
        std::array::from_fn(|i| Some(d[i]? / light[i]?))
    };
    let contrasts: Vec<(u64, f64)> = wide
        .iter()
        .map(|(s, d)| (s.pair, percentile(over_light(d).iter().flatten().map(|v| v.abs()).collect(), 0.5)))
        .collect();
    let contrasts = without_strays(&contrasts);
    let around = |pair: u64| between(&contrasts, pair, code.pairs() as u64);
    let usual = percentile(contrasts.iter().map(|(_, c)| *c).collect(), 0.5);
    let pair = |(shown, d): &(PairStarts, [Option<f64>; TICKS])| {
        let contrast = around(shown.pair)?;
        if contrast <= LEAST_CONTRAST * usual {
            return None;
        }
        let levels = over_light(d).map(|v| Some(0.5 + 0.5 * v? / contrast));
        let is_sound = |level: &f64| (-MOST_BEYOND..=1.0 + MOST_BEYOND).contains(level);
        if !levels.iter().flatten().all(is_sound) || levels.iter().flatten().next().is_none() {
            return None;
        }
        let mut begins_ns = shown.begins_ns.map(|b| record.base_ns.saturating_add(b.round() as i64));
        if code.is_inverse(2 * shown.pair) {
            begins_ns.swap(0, 1);
        }
        Some(Pair { number: shown.pair, begins_ns, levels, contrast })
    };
    let pairs: Vec<Pair> = raw.iter().filter_map(pair).collect();
    let dropped = raw.len() - pairs.len();
    (pairs, dropped)
}

/// Each number, or the median of its neighbours and itself: a sensor that is covered for a moment, or that crosses the
/// border of a wide stripe, must not dim the pairs around.
fn without_strays(all: &[(u64, f64)]) -> Vec<(u64, f64)> {
    let middle = |w: &[(u64, f64)]| (w[1].0, percentile(w.iter().map(|(_, c)| *c).collect(), 0.5));
    all.windows(3).map(middle).collect()
}

/// The contrast at a pair, on the line between those before and after it; `None` where these are further apart than `most`.
fn between(all: &[(u64, f64)], pair: u64, most: u64) -> Option<f64> {
    let after = all.partition_point(|(p, _)| *p < pair);
    let (b, last) = *all.get(after)?;
    if b == pair {
        return Some(last);
    }
    let (a, first) = *all.get(after.checked_sub(1)?)?;
    let share = (pair - a) as f64 / (b - a) as f64;
    (b - a <= most).then_some(first + share * (last - first))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_light_lies_where_its_planes_are_bright() {
        assert_eq!(FrameLight::Held.middle(0.2, 0.6), 0.4);
        let first = [1.0, 0.0, 0.0, 0.0];
        assert_eq!(FrameLight::Planes(&first).middle(0.0, 1.0), 0.125);
        // Half of the first part and half of the second, which is half as bright.
        let falling = [2.0, 1.0];
        assert!((FrameLight::Planes(&falling).middle(0.25, 0.75) - 0.34375 / 0.75).abs() < 1e-12);
        assert_eq!(FrameLight::Held.brightest(), [0.0, 1.0]);
        assert_eq!(FrameLight::Planes(&[1.0, 4.0, 4.0, 2.0]).brightest(), [0.25, 0.75]);
        // Where there is no light, any instant will do.
        assert_eq!(FrameLight::Planes(&first).middle(0.5, 1.0), 0.75);
    }
}
