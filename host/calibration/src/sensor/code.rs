//! What each of the 24 planes of a frame shows, as a pure function of frame, plane and pixel.
//!
//! Plane 0 is off and plane 1 is on. Then columns and rows follow in turn, from the most significant bit, in Gray code:
//! neighbours differ in one plane, so a tip on a border reads as one of the two. The last two planes are on and off
//! again, in an order that carries a bit of the frame's identity: on first for a one, off first for a zero. These bits
//! are a maximal sequence of 32 767 frames; any fifteen in a row name the frame. On and off at both ends of the frame
//! let the decoder follow a brightness that changes while the tip moves, and tell the beginning of a frame from its
//! middle.

use dpm_device::planes::Raster;
use std::sync::Arc;
use thiserror::Error;

/// Planes of a frame.
pub const PLANES: usize = 24;
/// Planes that carry columns and rows.
const CODED: usize = PLANES - 4;
/// Frames after which the identity repeats: a maximal sequence of degree 15.
pub(super) const IDENTITY_PERIOD: u64 = (1 << 15) - 1;
/// Widest stripe of the finest plane, pixels, as a power of two.
const COARSEST: u32 = 2;

/// Why a raster cannot be coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum CodeError {
    /// The planes of a frame do not number all columns and rows.
    #[error("sensor code: a raster of {width} x {height} pixels needs {needed} planes for columns and rows, even in stripes of {stripe} pixels; a frame has {CODED}")]
    TooLarge {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Planes needed.
        needed: u32,
        /// Stripe width that was tried, pixels.
        stripe: u32,
    },
}

/// What a plane shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Nothing.
    Off,
    /// All pixels.
    On,
    /// A bit of the column's Gray code: lit from `width` to three times `width`, repeated every four.
    Column {
        /// Pixels.
        width: u32,
    },
    /// The same of the row.
    Row {
        /// Pixels.
        width: u32,
    },
    /// On in frames whose bit of identity is set.
    IsSet,
    /// On in frames whose bit of identity is not set.
    IsClear,
}

/// A code for a raster. Copies share its table.
#[derive(Clone, Debug)]
pub struct Code {
    raster: Raster,
    roles: [Role; PLANES],
    identity: Arc<[u64]>,
}

impl Code {
    /// The code of a raster: stripes of one pixel where the planes suffice, else of two or four.
    ///
    /// # Errors
    /// [`CodeError::TooLarge`].
    pub fn new(raster: Raster) -> Result<Self, CodeError> {
        let (width, height) = (raster.width(), raster.height());
        let bits = |side: u32, shift: u32| u32::BITS - ((side - 1) >> shift).leading_zeros();
        // The longer side is made coarse first.
        let shifts = [(0, 0), (1, 0), (1, 1), (2, 1), (COARSEST, COARSEST)];
        let count = |(x, y): (u32, u32)| match width >= height {
            true => (bits(width, x), bits(height, y), x, y),
            false => (bits(width, y), bits(height, x), y, x),
        };
        let fits = shifts.into_iter().map(count).find(|(c, r, ..)| c + r <= CODED as u32);
        let Some((columns, rows, x, y)) = fits else {
            let (c, r, ..) = count((COARSEST, COARSEST));
            return Err(CodeError::TooLarge { width, height, needed: c + r, stripe: 1 << COARSEST });
        };
        let mut roles = [Role::Off; PLANES];
        (roles[1], roles[PLANES - 2], roles[PLANES - 1]) = (Role::On, Role::IsSet, Role::IsClear);
        let mut next = 2;
        for bit in (0..columns.max(rows)).rev() {
            if bit < columns {
                roles[next] = Role::Column { width: 1 << (bit + x) };
                next += 1;
            }
            if bit < rows {
                roles[next] = Role::Row { width: 1 << (bit + y) };
                next += 1;
            }
        }
        Ok(Self { raster, roles, identity: identity() })
    }

    /// The raster.
    pub fn raster(&self) -> Raster {
        self.raster
    }

    /// What a plane shows; nothing beyond the last.
    pub fn role(&self, plane: usize) -> Role {
        self.roles.get(plane).copied().unwrap_or(Role::Off)
    }

    /// The bit of identity of a frame.
    pub fn identity(&self, frame: u64) -> bool {
        let i = frame % IDENTITY_PERIOD;
        self.identity[(i / 64) as usize] >> (i % 64) & 1 == 1
    }

    /// Whether a pixel is lit.
    pub fn lit(&self, frame: u64, plane: usize, x: u32, y: u32) -> bool {
        let inside = x < self.raster.width() && y < self.raster.height();
        inside
            && match self.role(plane) {
                Role::Off => false,
                Role::On => true,
                Role::Column { width } => (x / width + 1) & 2 != 0,
                Role::Row { width } => (y / width + 1) & 2 != 0,
                Role::IsSet => self.identity(frame),
                Role::IsClear => !self.identity(frame),
            }
    }
}

/// One period of x^15 + x^14 + 1, packed.
pub(super) fn identity() -> Arc<[u64]> {
    let mut words = vec![0u64; IDENTITY_PERIOD.div_ceil(64) as usize];
    let mut state: u32 = 1;
    for i in 0..IDENTITY_PERIOD {
        words[(i / 64) as usize] |= u64::from(state & 1) << (i % 64);
        let fed = (state ^ (state >> 1)) & 1;
        state = state >> 1 | fed << 14;
    }
    words.into()
}
