//! The bit planes of one frame in one piece of memory, made once and filled again and again.

use super::source_bits;
use dpm_device::planes::{PlaneSchedule, Raster, MAX_PLANES};

/// One cache line.
#[derive(Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C, align(64))]
struct CacheLine([u8; 64]);

/// All planes of a frame, plane after plane in the order they are shown, starting on a cache line. The layout of a plane is
/// that of [`dpm_device::planes`].
#[derive(Clone)]
pub struct BitPlaneFrame {
    raster: Raster,
    schedule: PlaneSchedule,
    source_bits: [u8; MAX_PLANES],
    lines: Vec<CacheLine>,
}

impl BitPlaneFrame {
    /// A dark frame. This is the only place that allocates.
    pub fn new(raster: Raster, schedule: PlaneSchedule) -> Self {
        let source_bits = source_bits(&schedule);
        let len = raster.plane_bytes() * schedule.len();
        Self { raster, schedule, source_bits, lines: vec![CacheLine([0; 64]); len.div_ceil(64)] }
    }

    /// Mirrors of every plane.
    pub(crate) fn raster(&self) -> Raster {
        self.raster
    }

    /// Which plane shows what.
    pub fn schedule(&self) -> &PlaneSchedule {
        &self.schedule
    }

    /// Bytes of all planes together.
    pub fn len_bytes(&self) -> usize {
        self.raster.plane_bytes() * self.schedule.len()
    }

    /// All planes, one after the other.
    pub fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.lines)[..self.len_bytes()]
    }

    /// All planes, to be written.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        let len = self.len_bytes();
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..len]
    }

    /// Plane `index` of the schedule.
    ///
    /// # Panics
    /// When the schedule has no such plane.
    pub fn plane(&self, index: usize) -> &[u8] {
        let size = self.raster.plane_bytes();
        &self.bytes()[index * size..(index + 1) * size]
    }

    /// Plane `index` of the schedule, to be written. Padding bits must stay 0.
    ///
    /// # Panics
    /// When the schedule has no such plane.
    #[cfg(test)]
    pub(crate) fn plane_mut(&mut self, index: usize) -> &mut [u8] {
        let size = self.raster.plane_bytes();
        &mut self.bytes_mut()[index * size..(index + 1) * size]
    }

    /// Makes every plane dark.
    #[cfg(test)]
    pub(crate) fn clear(&mut self) {
        self.bytes_mut().fill(0);
    }

    /// The bit of the code value that each plane shows.
    pub(super) fn source_bits(&self) -> [u8; MAX_PLANES] {
        self.source_bits
    }
}

impl std::fmt::Debug for BitPlaneFrame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BitPlaneFrame")
            .field("raster", &self.raster)
            .field("planes", &self.schedule.len())
            .finish_non_exhaustive()
    }
}
