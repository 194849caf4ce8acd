//! The share of the panel's raster that is traced. A smaller one costs less; the pass `enlarge` brings its light to the panel's pixels.

use super::tiles::TILE;
use dpm_device::planes::Raster;

/// Shares among which a run chooses by its frame times, the largest first. Each step saves about half of the work.
pub const LADDER: [f64; 5] = [1.0, 0.75, 0.5, 0.35, 0.25];

/// Which share of the panel's columns and rows is traced.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Scale {
    /// Always this one, above 0 and at most 1.
    Share(f64),
    /// The one of [`LADDER`] that each frame asks for ([`crate::FrameInputs::rung`]).
    Ladder,
}

impl Scale {
    /// Every pixel of the panel is traced.
    pub const WHOLE: Self = Self::Share(1.0);

    /// The shares that frames may ask for, the largest first.
    pub fn shares(&self) -> &[f64] {
        match self {
            Self::Share(share) => std::slice::from_ref(share),
            Self::Ladder => &LADDER,
        }
    }

    /// The traced rasters of a panel, the largest first.
    pub(super) fn rasters(&self, panel: Raster) -> impl Iterator<Item = Raster> + '_ {
        self.shares().iter().map(move |&share| reduced(panel, share))
    }
}

/// The raster of this share of a panel's columns and rows, rounded up.
pub fn reduced(panel: Raster, share: f64) -> Raster {
    let side = |n: u32| ((f64::from(n) * share).ceil() as u32).clamp(1, n);
    Raster::new(side(panel.width()), side(panel.height())).expect("sides within those of a raster")
}

/// Cells of so many tiles of the panel, at most, and those before its first column and row. A cell is the square between the centres of four traced pixels,
/// and belongs to the tile of its first pixel (`cells.comp`).
pub(super) fn cells_of_tiles(tiles: u32, traced: Raster, panel: Raster) -> u32 {
    let side = |traced: u32, panel: u32| (TILE * traced).div_ceil(panel);
    let each = side(traced.width(), panel.width()) * side(traced.height(), panel.height());
    tiles * each + traced.width() + traced.height() + 1
}

/// How many pixels of a panel the cells of its smallest traced raster reach beyond a pixel of theirs, at most.
pub(super) fn reach_of_cells(scale: &Scale, panel: Raster) -> u32 {
    let most =
        |traced: Raster| panel.width().div_ceil(traced.width()).max(panel.height().div_ceil(traced.height()));
    scale.rasters(panel).map(most).max().unwrap_or(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_is_rounded_up_and_never_beyond_the_panel() {
        let panel = Raster::new(1921, 7).unwrap();
        let sides = |share| {
            let raster = reduced(panel, share);
            (raster.width(), raster.height())
        };
        assert_eq!(sides(1.0), (1921, 7));
        assert_eq!(sides(0.5), (961, 4));
        assert_eq!(sides(0.25), (481, 2));
        assert_eq!(sides(1e-9), (1, 1));
        assert!(LADDER.windows(2).all(|two| two[0] > two[1]) && LADDER[0] == 1.0);
    }
}
