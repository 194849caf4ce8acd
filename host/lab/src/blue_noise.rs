//! Nothing but a seed into dither masks that are blue in space and in time: those that the renderer reads are committed.
//!
//! Void and cluster \[Ulichney93\] with the energy of \[Wolfe22\]: texels of one slice repel each other by a Gaussian of their distance in
//! the image, texels of one pixel by a Gaussian of their distance in time, and others not at all. So every slice is blue noise, and the
//! values that one pixel takes over the frames are too; both wrap around. Energies are integers, so every machine makes the same mask.

use dpm_device::rng::Draws;
use dpm_render::blue_noise::{CHANNELS, FRAMES, SIZE};

/// Seeds of the committed masks, one a channel.
const SEEDS: [u64; CHANNELS] = [0x5eed_0001, 0x5eed_0002];

/// Standard deviation of both Gaussians in texels and in frames.
const SIGMA: f64 = 1.9;

/// The energy of a texel on itself; 24 bits keep the sum of all energies within `u32`.
const UNIT: f64 = 16_777_216.0;

/// Beyond this distance an energy rounds to zero.
const REACH: i32 = 11;

/// Share of texels in the first pattern.
const INITIAL_SHARE: usize = 10;

/// State of the algorithm on a `side` x `side` x `frames` torus.
struct Torus {
    side: usize,
    frames: usize,
    /// Energy that the set texels have at each texel.
    energy: Vec<u32>,
    set: Vec<bool>,
    /// (dx, dy, energy) of the spatial kernel.
    space: Vec<(i32, i32, u32)>,
    /// (dt, energy) of the temporal kernel, without dt = 0.
    time: Vec<(i32, u32)>,
    /// For each slice its set texel of greatest energy and its clear texel of least; `None` when it has to be looked for again.
    tightest: Vec<Option<usize>>,
    emptiest: Vec<Option<usize>>,
}

/// No texel: a slice that has none of the kind looked for.
const NONE: usize = usize::MAX;

impl Torus {
    fn new(side: usize, frames: usize) -> Self {
        let gauss = |d2: i32| (UNIT * (-f64::from(d2) / (2.0 * SIGMA * SIGMA)).exp()).round() as u32;
        let reach = |n: usize| REACH.min((n as i32 - 1) / 2);
        let (r, rt) = (reach(side), reach(frames));
        let space = (-r..=r)
            .flat_map(|dy| (-r..=r).map(move |dx| (dx, dy, gauss(dx * dx + dy * dy))))
            .filter(|k| k.2 > 0)
            .collect();
        let time =
            (-rt..=rt).filter(|&dt| dt != 0).map(|dt| (dt, gauss(dt * dt))).filter(|k| k.1 > 0).collect();
        let n = side * side * frames;
        Self {
            side,
            frames,
            energy: vec![0; n],
            set: vec![false; n],
            space,
            time,
            tightest: vec![None; frames],
            emptiest: vec![None; frames],
        }
    }

    /// Sets or clears a texel and carries its energy to its neighbours.
    fn flip(&mut self, texel: usize) {
        let (side, area) = (self.side as i32, self.side * self.side);
        let (slice, within) = (texel / area, texel % area);
        let (x, y) = ((within % self.side) as i32, (within / self.side) as i32);
        let adding = !self.set[texel];
        self.set[texel] = adding;
        let apply = |e: &mut u32, k: u32| *e = if adding { *e + k } else { *e - k };
        for &(dx, dy, k) in &self.space {
            let (x, y) = ((x + dx).rem_euclid(side) as usize, (y + dy).rem_euclid(side) as usize);
            apply(&mut self.energy[slice * area + y * self.side + x], k);
        }
        self.tightest[slice] = None;
        self.emptiest[slice] = None;
        for i in 0..self.time.len() {
            let (dt, k) = self.time[i];
            let other = (slice as i32 + dt).rem_euclid(self.frames as i32) as usize;
            let changed = other * area + within;
            apply(&mut self.energy[changed], k);
            self.note_change(other, changed, adding);
        }
    }

    /// Keeps a slice's tightest cluster and largest void right after the energy of one of its texels rose or fell.
    fn note_change(&mut self, slice: usize, changed: usize, rose: bool) {
        let (energy, set) = (&self.energy, &self.set);
        let keep = |best: usize, wanted: bool, moved_towards: bool| {
            if best == changed {
                return moved_towards.then_some(best);
            }
            let beats = |e: u32, than: u32| if wanted { e > than } else { e < than };
            let better = set[changed] == wanted
                && moved_towards
                && best != NONE
                && (beats(energy[changed], energy[best])
                    || energy[changed] == energy[best] && changed < best);
            Some(if better { changed } else { best })
        };
        self.tightest[slice] = self.tightest[slice].and_then(|best| keep(best, true, rose));
        self.emptiest[slice] = self.emptiest[slice].and_then(|best| keep(best, false, !rose));
    }

    /// The set texel of most energy or the clear one of least; the first of equals.
    fn search(&self, slice: usize, set: bool) -> usize {
        let area = self.side * self.side;
        let range = slice * area..(slice + 1) * area;
        let candidates = range.filter(|&i| self.set[i] == set);
        let found = if set {
            candidates.max_by(|&a, &b| self.energy[a].cmp(&self.energy[b]).then(b.cmp(&a)))
        } else {
            candidates.min_by_key(|&i| (self.energy[i], i))
        };
        found.unwrap_or(NONE)
    }

    /// The set texel with the most energy.
    fn tightest_cluster(&mut self) -> usize {
        let best = (0..self.frames).map(|s| {
            let texel = self.tightest[s].unwrap_or_else(|| self.search(s, true));
            self.tightest[s] = Some(texel);
            texel
        });
        let best: Vec<usize> = best.filter(|&t| t != NONE).collect();
        best.into_iter().max_by(|&a, &b| self.energy[a].cmp(&self.energy[b]).then(b.cmp(&a))).unwrap_or(NONE)
    }

    /// The clear texel with the least energy.
    fn largest_void(&mut self) -> usize {
        let best = (0..self.frames).map(|s| {
            let texel = self.emptiest[s].unwrap_or_else(|| self.search(s, false));
            self.emptiest[s] = Some(texel);
            texel
        });
        let best: Vec<usize> = best.filter(|&t| t != NONE).collect();
        best.into_iter().min_by_key(|&t| (self.energy[t], t)).unwrap_or(NONE)
    }
}

/// Ranks of all texels of a `side` x `side` x `frames` mask: a permutation of 0 to `side^2 * frames - 1`, x fastest, then y, then frames.
///
/// # Panics
/// When there are fewer than 100 texels: too few for a pattern.
fn generate(side: usize, frames: usize, seed: u64) -> Vec<u32> {
    let mut torus = Torus::new(side, frames);
    let n = torus.set.len();
    assert!(n >= 100, "a mask needs at least 100 texels");
    let draws = Draws::new(seed);
    let ones = n / INITIAL_SHARE;
    let (mut placed, mut k) = (0, 0);
    while placed < ones {
        let texel = (draws.unit(k) * n as f64) as usize;
        k += 1;
        if !torus.set[texel] {
            torus.flip(texel);
            placed += 1;
        }
    }
    // Move the tightest cluster to the largest void until that is where it came from. Each move lowers the total energy of an
    // integer system, so it ends; the bound is for ties.
    for _ in 0..4 * n {
        let cluster = torus.tightest_cluster();
        torus.flip(cluster);
        let void = torus.largest_void();
        torus.flip(void);
        if void == cluster {
            break;
        }
    }
    let mut rank = vec![0; n];
    let start = torus.set.clone();
    let energy = torus.energy.clone();
    for r in (0..ones).rev() {
        let cluster = torus.tightest_cluster();
        rank[cluster] = r as u32;
        torus.flip(cluster);
    }
    torus.set = start;
    torus.energy = energy;
    torus.tightest.fill(None);
    torus.emptiest.fill(None);
    // On a torus the energies of set and clear texels add up to the same everywhere, so the tightest cluster of clear texels is
    // the largest void of the set ones: one rule fills the mask to the end.
    for r in ones..n {
        let void = torus.largest_void();
        rank[void] = r as u32;
        torus.flip(void);
    }
    rank
}

/// The bytes of the committed masks, made anew (some seconds in optimised code).
pub fn generate_mask() -> Vec<u8> {
    let texels = SIZE * SIZE * FRAMES;
    let mut out = vec![0; texels * CHANNELS];
    for (channel, seed) in SEEDS.into_iter().enumerate() {
        for (texel, rank) in generate(SIZE, FRAMES, seed).into_iter().enumerate() {
            out[texel * CHANNELS + channel] = (rank as usize * 256 / texels) as u8;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_render::blue_noise::MASK;

    /// Power of a mask at an integer spatial frequency, one for white noise of unit variance.
    fn power(values: &[f64], side: usize, fx: i32, fy: i32) -> f64 {
        let (mut re, mut im) = (0.0, 0.0);
        for (i, v) in values.iter().enumerate() {
            let phase = std::f64::consts::TAU
                * (f64::from(fx) * (i % side) as f64 + f64::from(fy) * (i / side) as f64)
                / side as f64;
            re += v * phase.cos();
            im += v * phase.sin();
        }
        (re * re + im * im) / values.len() as f64
    }

    /// Values shifted and scaled to mean zero and variance one.
    fn standardised(values: impl Iterator<Item = f64>) -> Vec<f64> {
        let v: Vec<f64> = values.collect();
        let mean = v.iter().sum::<f64>() / v.len() as f64;
        let deviation = (v.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / v.len() as f64).sqrt();
        v.iter().map(|x| (x - mean) / deviation).collect()
    }

    fn slice(frame: usize, channel: usize) -> Vec<f64> {
        let texels =
            (0..SIZE * SIZE).map(|i| f64::from(MASK[(frame * SIZE * SIZE + i) * CHANNELS + channel]));
        standardised(texels)
    }

    fn mean_power_below(values: &[f64], side: usize, radius: i32) -> f64 {
        let inside = (-radius..=radius)
            .flat_map(|y| (0..=radius).map(move |x| (x, y)))
            .filter(|&(x, y)| x * x + y * y <= radius * radius && (x, y) != (0, 0));
        let powers: Vec<f64> = inside.map(|(x, y)| power(values, side, x, y)).collect();
        powers.iter().sum::<f64>() / powers.len() as f64
    }

    #[test]
    fn ranks_are_a_permutation_and_repeat_by_seed() {
        let ranks = generate(16, 8, 1);
        let mut sorted = ranks.clone();
        sorted.sort_unstable();
        assert!(sorted.iter().enumerate().all(|(i, &r)| i as u32 == r));
        assert_eq!(ranks, generate(16, 8, 1));
        assert_ne!(ranks, generate(16, 8, 2));
    }

    #[test]
    fn a_small_mask_is_blue_in_space_and_time() {
        let (side, frames) = (32, 8);
        let ranks = generate(side, frames, 3);
        for frame in 0..frames {
            let values = standardised(
                ranks[frame * side * side..(frame + 1) * side * side].iter().map(|&r| f64::from(r)),
            );
            let low = mean_power_below(&values, side, 4);
            assert!(low < 0.05, "slice {frame}: low frequencies have {low} of white noise's power");
        }
    }

    #[test]
    fn the_committed_masks_hold_every_value_equally_often_in_each_channel() {
        for channel in 0..CHANNELS {
            let mut count = [0usize; 256];
            MASK.iter().skip(channel).step_by(CHANNELS).for_each(|&v| count[v as usize] += 1);
            assert!(count.iter().all(|&c| c == SIZE * SIZE * FRAMES / 256), "channel {channel}");
        }
    }

    #[test]
    fn the_committed_masks_have_no_low_frequencies_in_space() {
        for (frame, channel) in [(0, 0), (17, 0), (31, 1)] {
            let values = slice(frame, channel);
            let low = mean_power_below(&values, SIZE, 8);
            assert!(low < 0.03, "frame {frame}: low frequencies have {low} of white noise's power");
            let high =
                power(&values, SIZE, 30, 17) + power(&values, SIZE, 25, -25) + power(&values, SIZE, 13, 31);
            assert!(high > 0.5, "the power must have gone somewhere: {high}");
        }
    }

    #[test]
    fn the_committed_masks_have_little_low_frequency_in_time() {
        let mut by_frequency = [0.0; FRAMES / 2 + 1];
        for pixel in (0..SIZE * SIZE).step_by(7) {
            let over_time = (0..FRAMES)
                .map(|t| (f64::from(MASK[(t * SIZE * SIZE + pixel) * CHANNELS]) - 127.5) / 73.9)
                .collect::<Vec<_>>();
            for (f, sum) in by_frequency.iter_mut().enumerate() {
                *sum += power(&over_time, FRAMES, f as i32, 0) / (SIZE * SIZE / 7) as f64;
            }
        }
        assert!(by_frequency[0] < 0.15 && by_frequency[1] < 0.2 && by_frequency[2] < 0.3, "{by_frequency:?}");
        assert!(by_frequency[FRAMES / 2] > 1.0, "{by_frequency:?}");
    }

    #[test]
    fn channels_do_not_correlate() {
        let correlation: f64 =
            slice(4, 0).iter().zip(slice(4, 1)).map(|(a, b)| a * b).sum::<f64>() / (SIZE * SIZE) as f64;
        assert!(correlation.abs() < 5.0 / SIZE as f64, "{correlation}");
    }

    /// The check sum of what [`generate_mask`] made; the example `make_blue_noise` compares all bytes.
    #[test]
    fn the_committed_masks_are_those_of_the_generator() {
        let fnv = |bytes: &[u8]| {
            bytes
                .iter()
                .fold(0xcbf2_9ce4_8422_2325u64, |h, &b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3))
        };
        assert_eq!(fnv(MASK), MASK_FNV1A, "{:#x}", fnv(MASK));
        let small: Vec<u8> = generate(16, 8, SEEDS[0]).iter().flat_map(|r| r.to_le_bytes()).collect();
        assert_eq!(fnv(&small), SMALL_FNV1A, "the generator changed: {:#x}", fnv(&small));
    }

    const MASK_FNV1A: u64 = 0x03b7_45ed_80ed_1035;
    const SMALL_FNV1A: u64 = 0xb3a1_bc1b_7db6_4125;
}
