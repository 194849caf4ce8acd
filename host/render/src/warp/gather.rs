//! The CPU twin of `shaders/glsl/warp.comp`.

use dpm_device::planes::Raster;
use dpm_shaders::structs::{Moved, Mover, PlaneGroup, OWNER_NONE, OWNER_STILL};

/// A frame as it was drawn, and how its surfaces move.
#[derive(Clone, Copy, Debug)]
pub struct Drawn<'a> {
    /// Size of the picture.
    pub raster: Raster,
    /// What the pass `motion` tells of every pixel.
    pub pixels: &'a [Moved],
    /// The bodies that move.
    pub movers: &'a [Mover],
    /// The words are code values, and what lies between pixels is interpolated. Words of halftones are taken whole.
    pub are_codes: bool,
}

/// What a mirror shows at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Place {
    /// The place in the picture that was drawn, in 1/64 pixel; a pixel's centre is a multiple of 64.
    at: [i32; 2],
    /// Who is there; `OWNER_NONE` for a hole, which takes whatever is near.
    owner: u32,
}

/// Motion of a pixel's surface on the raster during the exposure, to the right and down, in 1/64 pixel.
pub fn motion_of(moved: &Moved) -> [i32; 2] {
    [moved.motion as i16, (moved.motion >> 16) as i16].map(i32::from)
}

/// Who owns a pixel: `OWNER_NONE`, `OWNER_STILL`, or the number of a mover, from 1 on, plus `OWNER_STILL`.
pub fn owner_of(moved: &Moved) -> u32 {
    moved.owner_and_depth >> 24
}

/// Distance of a pixel's surface from the projector, in steps that grow with it.
fn depth_of(moved: &Moved) -> u32 {
    moved.owner_and_depth & 0xff_ffff
}

/// The place that a point comes from which reaches the middle of `pixel` at `instant` and moves by `motion` during the
/// exposure, in 1/64 pixel.
fn source(pixel: [i32; 2], motion: [i32; 2], instant: i32) -> [i32; 2] {
    [0, 1].map(|c| (pixel[c] << 6) - ((motion[c] * instant + 32768) >> 16))
}

/// The pixel in which a place is.
fn nearest(at: [i32; 2]) -> [i32; 2] {
    at.map(|c| (c + 32) >> 6)
}

impl Drawn<'_> {
    /// The word of a mirror whose planes follow: its bits are those of `groups` at their instants, and the bits that no
    /// group shows are as they were drawn.
    ///
    /// # Panics
    /// When the pixel lies outside the raster, or `pixels` is shorter than it.
    pub fn word(&self, pixel: [i32; 2], groups: &[PlaneGroup]) -> u32 {
        let mut word = self.at(pixel).word;
        for group in groups {
            let there = self.place_at(pixel, group.instant).map_or(0, |place| self.word_at(place));
            word = (word & !group.mask) | (there & group.mask);
        }
        word
    }

    /// The pixel whose surface is at the mirror `pixel` at `instant`; `None`: nothing is there.
    pub fn source_at(&self, pixel: [i32; 2], instant: i32) -> Option<[i32; 2]> {
        self.place_at(pixel, instant).map(|place| nearest(place.at))
    }

    fn place_at(&self, pixel: [i32; 2], instant: i32) -> Option<Place> {
        let own = self.at(pixel);
        let owner = owner_of(own);
        let (mut closest, mut found) = (u32::MAX, None);
        if owner == OWNER_STILL {
            (closest, found) = (depth_of(own), Some(Place { at: pixel.map(|c| c << 6), owner }));
        }
        for (mover, number) in self.movers.iter().zip(OWNER_STILL + 1..) {
            if !within(mover, pixel) {
                continue;
            }
            let of_mover = |at| self.moved_at(mover, nearest(at)).filter(|m| owner_of(m) == number);
            // The point's motion is that of the point that is here now, or of what is about where it comes from.
            let here = (owner == number).then_some(own);
            let near = here.or_else(|| of_mover(source(pixel, start_of(mover, pixel), instant)));
            let Some(near) = near else { continue };
            let at = source(pixel, motion_of(near), instant);
            let Some(there) = of_mover(at) else { continue };
            if depth_of(there) < closest {
                (closest, found) = (depth_of(there), Some(Place { at, owner: number }));
            }
        }
        if found.is_some() || owner <= OWNER_STILL {
            return found;
        }
        // A body has left this mirror and uncovers what was hidden. What is seen behind its edge goes on here.
        let at = source(pixel, motion_of(own), instant);
        let behind = self.moved_at(self.mover_of(owner), nearest(at));
        behind.filter(|m| owner_of(m) != OWNER_NONE).map(|_| Place { at, owner: OWNER_NONE })
    }

    /// The word at a place: that of its pixel, or code values between those of the pixels around it that show the same
    /// body.
    fn word_at(&self, Place { at, owner }: Place) -> u32 {
        if !self.are_codes || owner <= OWNER_STILL {
            return self.at(nearest(at)).word;
        }
        let mover = self.mover_of(owner);
        let part = at.map(|c| (c & 63) as u32);
        let (mut weights, mut sums) = (0, [0; 3]);
        for step in [[0, 0], [1, 0], [0, 1], [1, 1]] {
            let pixel = [0, 1].map(|c| (at[c] >> 6) + step[c]);
            let [x, y] = [0, 1].map(|c| if step[c] == 1 { part[c] } else { 64 - part[c] });
            if let Some(there) = self.moved_at(mover, pixel).filter(|m| owner_of(m) == owner) {
                weights += x * y;
                (0..3).for_each(|c| sums[c] += x * y * ((there.word >> (8 * c)) & 0xff));
            }
        }
        // The nearest of the four shows the body, so the weights are positive.
        let code = |c: usize| ((sums[c] + weights / 2) / weights) << (8 * c);
        code(0) | code(1) | code(2)
    }

    fn mover_of(&self, owner: u32) -> &Mover {
        &self.movers[(owner - OWNER_STILL - 1) as usize]
    }

    /// What is at a pixel in the area of `mover`; `None` outside of it.
    fn moved_at(&self, mover: &Mover, pixel: [i32; 2]) -> Option<&Moved> {
        within(mover, pixel).then(|| self.at(pixel))
    }

    fn at(&self, [x, y]: [i32; 2]) -> &Moved {
        &self.pixels[y as usize * self.raster.width() as usize + x as usize]
    }
}

/// True in the area in which the light of `mover` can fall.
pub fn within(mover: &Mover, pixel: [i32; 2]) -> bool {
    (0..2).all(|c| pixel[c] >= mover.lower[c] && pixel[c] < mover.upper[c])
}

/// How the body moves at a pixel, about: all that is known where the pixel does not show it.
fn start_of(mover: &Mover, pixel: [i32; 2]) -> [i32; 2] {
    let [x, y] = [0, 1].map(|c| pixel[c] - mover.centre[c]);
    let of = |c: usize| {
        let slope = [mover.slope[2 * c], mover.slope[2 * c + 1]];
        (mover.start[c] + ((slope[0] * x + slope[1] * y) >> 12)).clamp(-32767, 32767)
    };
    [of(0), of(1)]
}
