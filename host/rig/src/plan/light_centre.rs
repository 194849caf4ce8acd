//! The instant of the centre of a frame's light.
//!
//! The planes of a frame are lit one after the other for equal times, each with the intensity of its bit. If the high
//! bits come first, most of the light is over long before the middle of the exposure. An eye that follows a body sees
//! the picture where the centre of the light puts it.

use crate::config::{LitTime, PlanePoses, PlaneTiming, ProjectorConfig};
use crate::rig::Rig;
use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec};
use dpm_device::time::HostTime;
use dpm_render::pack::{source_bits, Halftone};
use dpm_render::warp::plane_groups;
use dpm_shaders::structs::PlaneGroup;
use glam::DAffine3;

/// Time from the first photon to the centre of the light of a frame of `rig` that is lit for `exposure_ns` >= 0, in
/// nanoseconds. Rounded down; 0 for a negative exposure.
///
/// The function assumes white, with every bit of every channel set. The actual code value shifts the centre of each
/// pixel.
pub(crate) fn light_centre_ns(rig: &Rig, exposure_ns: i64) -> i64 {
    Lights::of(rig).centre_ns(exposure_ns)
}

/// The centre of the light of a whole frame of `rig` whose first photon left at `first_photon_at`.
pub(crate) fn light_centre_at(rig: &Rig, first_photon_at: HostTime) -> HostTime {
    first_photon_at.plus_ns(light_centre_ns(rig, rig.rate().slot_len_ns(0)))
}

/// The true world-from-mesh transform of every tracked body at the centre of the light of a whole frame of `rig` whose first
/// photon left at `first_photon_at`; `None` unless the tracker is the mock.
pub(crate) fn true_poses_at_centre(rig: &Rig, first_photon_at: HostTime) -> Option<Vec<DAffine3>> {
    rig.true_poses(light_centre_at(rig, first_photon_at).0)
}

/// The light of each plane of a frame of `rig`: the time from the first photon to the middle of the plane in nanoseconds,
/// rounded down, and the light of a mirror that is on, in units of the lowest bit. Where code values are held for the
/// whole frame, it is shared out over as many equal parts.
pub(crate) fn lights_of_frame(rig: &Rig, exposure_ns: i64) -> impl Iterator<Item = (i64, f64)> + '_ {
    let lights = Lights::of(rig);
    let middle = move |(_, halves)| lights.instant_ns(halves, 1, exposure_ns);
    lights.planes().map(move |plane| (middle(plane), f64::from(lights.light_of(plane.0))))
}

/// True if planes are shown where the bodies are at their own instants.
pub(crate) fn planes_follow(rig: &Rig) -> bool {
    rig.config.projector.plane_poses == PlanePoses::Own && Lights::of(rig).timing != PlaneTiming::Held
}

/// For each plane of a frame of `rig` the time from the frame's instant, which is the centre of its light, to the instant
/// for which the plane shows the bodies, as a share of the exposure.
pub(crate) fn instants_of_planes(rig: &Rig) -> Vec<f64> {
    let groups = groups_that_follow(rig);
    let bits = source_bits(&rig.schedule);
    let of = |bit: &u8| groups.iter().find(|g| g.mask >> bit & 1 == 1).map_or(0, |g| g.instant);
    bits[..rig.schedule.len()].iter().map(|bit| f64::from(of(bit)) / 65536.0).collect()
}

/// The groups of planes of `rig` that follow the bodies, each at its own instant; none if all planes show the bodies at
/// the centre of the light.
pub(crate) fn groups_that_follow(rig: &Rig) -> Vec<PlaneGroup> {
    if !planes_follow(rig) {
        return Vec::new();
    }
    let lights = Lights::of(rig);
    let share = lights.follow(rig.config.projector.plane_follow);
    plane_groups(lights.schedule, &lights.shares().map(|own| own * share).collect::<Vec<_>>())
}

/// Length of the frames of which `projector.plane_follow` is a share, nanoseconds: 947 frames/s.
const SHARE_IS_OF_NS: f64 = 1e9 / 947.0;

/// When the planes of a frame are lit, and how much light they give.
#[derive(Clone, Copy)]
pub(super) struct Lights<'a> {
    pub(super) schedule: &'a PlaneSchedule,
    pub(super) timing: PlaneTiming,
    pub(super) lit: LitTime,
}

impl<'a> Lights<'a> {
    fn of(rig: &'a Rig) -> Self {
        Self::of_projector(&rig.config.projector, &rig.schedule)
    }

    pub(super) fn of_projector(projector: &ProjectorConfig, schedule: &'a PlaneSchedule) -> Self {
        Self { schedule, timing: projector.plane_timing(), lit: projector.lit_time() }
    }

    /// How far planes go on the way from the centre of the light to their own instant, if those of a projector at 947 frames/s
    /// that shows bits go the share `told`. In longer frames the same time is left of the way: it is worth while as long as
    /// bodies move by few pixels in it. Halftones, and patterns of several bits, which are lit whole, go all of it.
    fn follow(self, told: f64) -> f64 {
        let is_lit_by_bits = !matches!(self.timing, PlaneTiming::Together { .. } | PlaneTiming::ByChannel);
        if is_lit_by_bits && Halftone::of(self.schedule).is_none() {
            1.0 - (1.0 - told) * (SHARE_IS_OF_NS / self.lit.frame_ns as f64).min(1.0)
        } else {
            1.0
        }
    }

    /// How long a plane lasts, in units that all planes share.
    fn length_of(self, plane: PlaneSpec) -> i128 {
        match self.timing {
            PlaneTiming::ByWeight => 1 << plane.bit,
            _ => 1,
        }
    }

    /// How long the pattern lasts that shows a plane, with its dark time, in the units of [`Self::length_of`].
    fn pattern_length_of(self, plane: PlaneSpec) -> i128 {
        match self.timing {
            PlaneTiming::Together { planes } => planes.into(),
            PlaneTiming::ByChannel => self.count_of(plane.channel),
            _ => self.length_of(plane),
        }
    }

    fn count_of(self, channel: Channel) -> i128 {
        self.schedule.planes().iter().filter(|plane| plane.channel == channel).count() as i128
    }

    /// The light of a plane.
    pub(super) fn light_of(self, plane: PlaneSpec) -> u32 {
        match self.timing {
            PlaneTiming::Held => 1,
            _ => 1 << plane.bit,
        }
    }

    /// How long the planes are lit together, in the units of [`Self::length_of`].
    fn whole(self) -> i128 {
        self.schedule.planes().iter().map(|plane| self.length_of(*plane)).sum()
    }

    /// Every plane with twice the time from the first photon to the middle of its pattern, dark time included, in the units of
    /// [`Self::length_of`].
    fn planes(self) -> impl Iterator<Item = (PlaneSpec, i128)> + 'a {
        self.schedule.planes().iter().scan(0, move |begin, plane| {
            let length = self.length_of(*plane);
            let halves = match self.timing {
                // The middle of the planes that are lit together, whose lengths are 1.
                PlaneTiming::Together { planes } => {
                    2 * (*begin - *begin % i128::from(planes)) + i128::from(planes)
                }
                PlaneTiming::ByChannel => {
                    let channels = [Channel::Red, Channel::Green, Channel::Blue, Channel::White];
                    let before = channels.into_iter().take_while(|c| *c != plane.channel);
                    2 * before.map(|c| self.count_of(c)).sum::<i128>() + self.count_of(plane.channel)
                }
                _ => 2 * *begin + length,
            };
            *begin += length;
            Some((*plane, halves))
        })
    }

    /// When each plane is lit, nanoseconds from the first photon on.
    pub(super) fn spans(self) -> impl Iterator<Item = (PlaneSpec, [f64; 2])> + 'a {
        let unit_ns = self.lit.whole_ns as f64 / (2 * self.whole()) as f64;
        self.planes().map(move |(plane, halves)| {
            let length = self.pattern_length_of(plane);
            let end_ns = (halves + length) as f64 * unit_ns - self.lit.dark_ns as f64;
            (plane, [(halves - length) as f64 * unit_ns, end_ns])
        })
    }

    /// Sum of the planes' middles, as [`Self::planes`] gives them, each weighted with its light; and sum of the light.
    fn moments(self) -> [i128; 2] {
        self.planes().fold([0, 0], |[moments, light], (plane, halves)| {
            let of = i128::from(self.light_of(plane));
            [moments + of * halves, light + of]
        })
    }

    /// For each plane the time from the centre of the light to its middle, as a share of the frame.
    fn shares(self) -> impl Iterator<Item = f64> + 'a {
        let [moments, light] = self.moments();
        let centre = moments as f64 / light as f64;
        let share = self.lit.whole_ns as f64 / self.lit.frame_ns as f64 / (2 * self.whole()) as f64;
        self.planes().map(move |(_, halves)| (halves as f64 - centre) * share)
    }

    /// As [`light_centre_ns`].
    fn centre_ns(self, exposure_ns: i64) -> i64 {
        // A schedule has 1 to 32 planes of bits below 8, so nothing here overflows, and the light is positive.
        let [moments, light] = self.moments();
        self.instant_ns(moments, light, exposure_ns)
    }

    /// Time from the first photon to the middle of the light of patterns whose middle is at `halves / over`, in units as
    /// [`Self::planes`] gives them, for a frame of `exposure_ns`. Every pattern's light is over half a dark time sooner.
    fn instant_ns(self, halves: i128, over: i128, exposure_ns: i64) -> i64 {
        let [whole, dark, frame] = [self.lit.whole_ns, self.lit.dark_ns, self.lit.frame_ns].map(i128::from);
        let units = self.whole() * over;
        (i128::from(exposure_ns.max(0)) * (whole * halves - dark * units) / (2 * units * frame)) as i64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_device::planes::{Channel, Parts};

    const SLOT: i64 = 1_055_966;

    fn centre_ns(schedule: &PlaneSchedule, timing: PlaneTiming, exposure_ns: i64) -> i64 {
        Lights { schedule, timing, lit: LIT }.centre_ns(exposure_ns)
    }

    /// Lit from the first photon to the last.
    const LIT: LitTime = LitTime { whole_ns: 1, dark_ns: 0, frame_ns: 1 };

    /// A plane is left behind its own instant by no more time in a long frame than in one of 947 a second.
    #[test]
    fn planes_of_bits_follow_by_a_share_that_leaves_no_more_time_in_longer_frames() {
        let follow = |schedule: &PlaneSchedule, timing, frame_ns| {
            let lit = LitTime { whole_ns: frame_ns, dark_ns: 0, frame_ns };
            Lights { schedule, timing, lit }.follow(0.8)
        };
        let bits = PlaneSchedule::rgb24();
        let left_us =
            |frame_ns: i64| (1.0 - follow(&bits, PlaneTiming::Equal, frame_ns)) * frame_ns as f64 / 1000.0;
        assert_eq!(follow(&bits, PlaneTiming::Equal, 500_000), 0.8);
        for frame_ns in [SLOT, 4 * SLOT, 41_666_667] {
            assert!((left_us(frame_ns) - 0.2 * SLOT as f64 / 1000.0).abs() < 1e-3, "{}", left_us(frame_ns));
        }
        // Grey of these does not come from bits that are lit apart.
        assert_eq!(follow(&PlaneSchedule::equal_rgb24(), PlaneTiming::Equal, SLOT), 1.0);
        assert_eq!(follow(&bits, PlaneTiming::Together { planes: 8 }, SLOT), 1.0);
    }

    #[test]
    fn the_order_of_rgb24_has_its_centre_at_194_us() {
        assert_eq!((centre_ns(&PlaneSchedule::rgb24(), PlaneTiming::Equal, SLOT) + 500) / 1000, 194);
    }

    /// Light that is the same from the first photon to the last has its centre in the middle, whatever the planes.
    #[test]
    fn even_light_has_its_centre_in_the_middle() {
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::equal24()] {
            for timing in [PlaneTiming::ByWeight, PlaneTiming::Held] {
                assert_eq!(centre_ns(&schedule, timing, SLOT), SLOT / 2);
            }
        }
    }

    /// The middles of planes that last as long as they weigh: the first of `7 6 5 ...` takes half of the exposure.
    #[test]
    fn planes_follow_one_another_without_gaps() {
        let lights = Lights { schedule: &PlaneSchedule::mono8(), timing: PlaneTiming::ByWeight, lit: LIT };
        let mut end = 0;
        for (plane, halves) in lights.planes() {
            assert_eq!(halves - end, 1 << plane.bit);
            end = halves + (1 << plane.bit);
        }
        assert_eq!(end, 2 * lights.whole());
    }

    /// The centres of a schedule and of its mirror image lie at equal distances from the middle. With equal weights
    /// the centre is the middle. Every centre lies inside the exposure.
    #[test]
    fn centres_obey_the_symmetry_of_the_order() {
        let timing = PlaneTiming::Equal;
        for schedule in [PlaneSchedule::rgb24(), PlaneSchedule::mono8()] {
            let mut planes = schedule.planes().to_vec();
            planes.reverse();
            let mirrored = PlaneSchedule::new(&planes).unwrap();
            for exposure in [0, 1, 7, SLOT, 1_000_000_000_000] {
                let (a, b) = (centre_ns(&schedule, timing, exposure), centre_ns(&mirrored, timing, exposure));
                // Each value is rounded down by less than 1 ns.
                assert!((exposure - 1..=exposure).contains(&(a + b)), "{a} + {b} of {exposure}");
                assert!((0..=exposure).contains(&a));
            }
        }
        let equal =
            [Channel::Red, Channel::Green, Channel::Blue].map(|channel| PlaneSpec { channel, bit: 3 });
        assert_eq!(centre_ns(&PlaneSchedule::new(&equal).unwrap(), timing, 600), 300);
        assert_eq!(centre_ns(&PlaneSchedule::mono8(), timing, -5), 0);
    }

    /// 24 patterns of 620 us in a sixtieth of a second, with or without a dark time, or three of 4960 us: the instants are those at which a DLPC900 shows
    /// them, whatever is left of the frame.
    #[test]
    fn planes_of_a_controller_behind_a_display_have_its_instants() {
        let frame_ns = 16_666_667;
        let lit = |whole_ns, dark_ns| LitTime { whole_ns, dark_ns, frame_ns };
        let middles = |schedule: &PlaneSchedule, timing, whole_ns, dark_ns| -> Vec<i64> {
            let lights = Lights { schedule, timing, lit: lit(whole_ns, dark_ns) };
            let centre = lights.centre_ns(frame_ns);
            let from_shares = lights.shares().map(|s| centre + (s * frame_ns as f64) as i64);
            let all = lights.planes().map(|(_, halves)| lights.instant_ns(halves, 1, frame_ns));
            assert!(all.zip(from_shares).all(|(a, b)| (a - b).abs() <= 2));
            // A plane is lit about its middle.
            let spans = lights.spans().map(|(_, [begin, end])| ((begin + end) / 2.0) as i64);
            let all: Vec<i64> =
                lights.planes().map(|(_, halves)| lights.instant_ns(halves, 1, frame_ns)).collect();
            assert!(all.iter().zip(spans).all(|(a, b)| (a - b).abs() <= 2));
            all
        };
        for dark_ns in [0, 64_000] {
            let pitch_ns = 620_000 + dark_ns;
            let planes = middles(&PlaneSchedule::equal_rgb24(), PlaneTiming::Equal, 24 * pitch_ns, dark_ns);
            assert!(
                planes.iter().zip(0..).all(|(at, k)| (at - (pitch_ns * k + 310_000)).abs() <= 1),
                "{planes:?}"
            );
        }
        // Loaded patterns: red, green and blue in turn, whatever the order of the bits.
        let third = frame_ns / 3;
        let loaded = middles(&PlaneSchedule::rgb24(), PlaneTiming::ByChannel, 3 * third, 100_000);
        for (plane, at) in PlaneSchedule::rgb24().planes().iter().zip(loaded) {
            let wanted = third * plane.channel as i64 + (third - 100_000) / 2;
            assert!((at - wanted).abs() <= 2, "{plane:?}: {at}");
        }
        for (count, depth, white) in [(1, 8, false), (3, 8, true), (4, 6, true), (2, 4, false), (12, 2, true)]
        {
            let schedule = PlaneSchedule::of_parts(Parts { count, depth, low: 0, white }).unwrap();
            let timing = PlaneTiming::Together { planes: depth };
            let pattern_ns = 24 / i64::from(depth) * 100_000;
            let lit_ns = pattern_ns * 24 / i64::from(depth);
            let middles = middles(&schedule, timing, lit_ns, 0);
            for (i, at) in middles.iter().enumerate() {
                let wanted = pattern_ns * (i as i64 / i64::from(depth)) + pattern_ns / 2;
                assert!((at - wanted).abs() <= 1, "{count} x {depth}, plane {i}: {at}");
            }
            let all = Lights { schedule: &schedule, timing, lit: lit(lit_ns, 0) };
            assert!((all.centre_ns(frame_ns) - lit_ns / 2).abs() <= 1, "the middle of all");
            // Planes that are lit together follow together: a pattern is a group, at its own instant.
            let groups = plane_groups(&schedule, &all.shares().collect::<Vec<_>>());
            assert_eq!(groups.len(), 24 / usize::from(depth));
            assert!(groups.windows(2).all(|pair| pair[0].instant < pair[1].instant));
            assert!(
                groups.iter().all(|group| group.mask.count_ones() == u32::from(depth)),
                "{count} x {depth}: {groups:?}"
            );
        }
    }
}
