//! A picture into the tags that it shows.

use crate::decode::{read, Family};
use crate::edges::refine;
use crate::image::GreyImage;
use crate::outline::{Outlines, Quad};
use crate::threshold::Binary;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::DVec2;

/// Quadrilaterals of a picture that are looked into; a picture full of windows has hundreds.
const MOST_QUADS: usize = 512;

/// A tag in a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TagSighting {
    /// Its number in the family AprilTag 36h11.
    pub id: u16,
    /// The corners of its black border, pixels: as printed upright, from the upper left clockwise.
    pub corners: [DVec2; 4],
    /// Standard deviation of each corner along each axis, pixels.
    pub sigma_px: [f64; 4],
    /// Cells that were read wrong and corrected.
    pub wrong_cells: u32,
}

/// Finds tags. It keeps its memory from picture to picture.
#[derive(Debug)]
pub struct TagDetector {
    pub(crate) binary: Binary,
    outlines: Outlines,
    quads: Vec<Quad>,
    family: Family,
}

impl Default for TagDetector {
    fn default() -> Self {
        Self::new()
    }
}

impl TagDetector {
    /// A detector of the family AprilTag 36h11.
    pub fn new() -> Self {
        let (binary, outlines) = (Binary::default(), Outlines::default());
        Self { binary, outlines, quads: Vec::with_capacity(MOST_QUADS), family: Family::new() }
    }

    /// The tags of a picture, in no particular order. `lens`: the camera, whose lens bends edges; without it edges are straight.
    /// A number that is seen twice is left out: nobody could say which of the two is meant.
    pub fn detect(
        &mut self,
        image: &GreyImage<'_>,
        lens: Option<&ProjectorCamera>,
        tags: &mut Vec<TagSighting>,
    ) {
        tags.clear();
        self.binary.fill(image);
        self.quads.clear();
        self.outlines.quads(image, &mut self.binary.dark, &mut self.quads, MOST_QUADS);
        for quad in &self.quads {
            let Some(reading) = read(image, quad, &self.family) else { continue };
            let Some(corners) = refine(image, quad, reading.contrast, lens) else { continue };
            // From the corner at which the outline was begun to the tag's own first one.
            let own = |i: usize| (i + reading.turn) % 4;
            tags.push(TagSighting {
                id: reading.id,
                corners: std::array::from_fn(|i| corners.pixels[own(i)]),
                sigma_px: std::array::from_fn(|i| corners.sigma_px[own(i)]),
                wrong_cells: reading.wrong,
            });
        }
        tags.sort_by_key(|t| t.id);
        let twice: Vec<u16> = tags.windows(2).filter(|w| w[0].id == w[1].id).map(|w| w[0].id).collect();
        tags.retain(|t| !twice.contains(&t.id));
    }
}

/// How many tags the family has: numbers from 0 to one less.
pub const TAGS: usize = Family::LEN;
