//! Converts picture files to DLPC900 patterns.

use dpm_device::planes::Raster;
use dpm_device::regular_file;
use dpm_dlpc900::image::{Compression, PlaneOrder};
use dpm_dlpc900::lut::Dmd;
use dpm_dlpc900::sequence::{BitPattern, PatternSequence, Repeat, SequenceBuilder, SequenceError};
use image::ImageFormat;
use std::path::{Path, PathBuf};

/// Why pictures cannot be made into a sequence.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PatternFileError {
    /// A file cannot be read.
    #[error("{}: {why}", path.display())]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// The reader's message.
        why: String,
    },
    /// A picture has the wrong size.
    #[error("{}: {width} x {height} pixels, the {dmd} has {dmd_width} x {dmd_height}: scale the picture", path.display())]
    Size {
        /// Path of the file.
        path: PathBuf,
        /// Its width.
        width: u32,
        /// Its height.
        height: u32,
        /// The DMD.
        dmd: &'static str,
        /// The DMD's width.
        dmd_width: u32,
        /// The DMD's height.
        dmd_height: u32,
    },
    /// The patterns break a rule of the controller.
    #[error(transparent)]
    Sequence(#[from] SequenceError),
}

/// How pictures are shown.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShowAs {
    /// Bits per pattern, 1 to 8, taken from the pictures' highest bits (1: black below 128).
    pub depth: u8,
    /// Exposure, microseconds; `None` for the shortest that the DMD supports.
    pub exposure_us: Option<u32>,
    /// Dark time after each pattern, microseconds.
    pub dark_us: u32,
    /// LEDs as coded in the pattern table: 1 red, 2 green, 4 blue.
    pub leds: u8,
    /// Each pattern waits for an edge at TRIG_IN1.
    pub wait_trigger: bool,
    /// How often the sequence runs.
    pub repeat: Repeat,
    /// The order of the bytes that contain the planes.
    pub order: PlaneOrder,
    /// How images are coded; `None` for the smallest coding.
    pub compression: Option<Compression>,
}

/// What to tell of OpenEXR in a program without it.
const NO_OPENEXR: &str =
    "this is OpenEXR, and this program was built without its feature \"exr\"; convert the picture to PNG, or build the program with that feature";

/// Largest picture file that is read, bytes.
const MAX_PICTURE_BYTES: u64 = 256 << 20;

/// Reads a picture of exactly the DMD's size as grey values. The size is checked before pixels are decoded.
pub(crate) fn read_grey(path: &Path, dmd: Dmd) -> Result<Vec<u8>, PatternFileError> {
    let fail = |why: String| PatternFileError::Read { path: path.to_owned(), why };
    let bytes = regular_file::read(path, MAX_PICTURE_BYTES).map_err(|e| fail(e.to_string()))?;
    let open = || {
        let reader = image::ImageReader::new(std::io::Cursor::new(&bytes));
        let reader = reader.with_guessed_format().map_err(|e| fail(e.to_string()))?;
        let is_left_out =
            reader.format() == Some(ImageFormat::OpenExr) && !ImageFormat::OpenExr.reading_enabled();
        match is_left_out {
            true => Err(fail(NO_OPENEXR.into())),
            false => Ok(reader),
        }
    };
    let (width, height) = open()?.into_dimensions().map_err(|e| fail(e.to_string()))?;
    let raster = dmd.raster();
    if (width, height) != (raster.width(), raster.height()) {
        let (dmd_width, dmd_height) = (raster.width(), raster.height());
        let path = path.to_owned();
        return Err(PatternFileError::Size { path, width, height, dmd: dmd.name(), dmd_width, dmd_height });
    }
    Ok(open()?.decode().map_err(|e| fail(e.to_string()))?.into_luma8().into_raw())
}

/// Converts the `depth` highest bits of grey values to planes, least significant first.
pub(crate) fn planes_of(grey: &[u8], raster: Raster, depth: u8) -> Vec<Vec<u8>> {
    let depth = depth.clamp(1, 8);
    let plane = |bit: u8| {
        let mut plane = vec![0u8; raster.plane_bytes()];
        let rows = grey.chunks_exact(raster.width() as usize).zip(plane.chunks_mut(raster.row_bytes()));
        for (pixels, cells) in rows {
            for (x, p) in pixels.iter().enumerate() {
                cells[x / 8] |= (p >> bit & 1) << (7 - x % 8);
            }
        }
        plane
    };
    (8 - depth..8).map(plane).collect()
}

/// Makes a sequence of `files`, one pattern each, in order.
pub(crate) fn sequence_of(
    files: &[PathBuf],
    dmd: Dmd,
    show: &ShowAs,
) -> Result<PatternSequence, PatternFileError> {
    let mut all = Vec::with_capacity(files.len());
    for file in files {
        all.push(planes_of(&read_grey(file, dmd)?, dmd.raster(), show.depth));
    }
    let shortest = dmd.min_exposure_us(show.depth).unwrap_or(105);
    let mut builder = SequenceBuilder::new(dmd);
    for planes in &all {
        builder.push(&BitPattern {
            planes: planes.iter().map(Vec::as_slice).collect(),
            exposure_us: show.exposure_us.unwrap_or(shortest),
            dark_us: show.dark_us,
            leds: show.leds,
            wait_trigger: show.wait_trigger,
            no_trigger_out2: false,
        });
    }
    Ok(builder.finish(show.repeat, show.order, show.compression)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_bits_become_planes_least_significant_first() {
        let raster = Raster::new(10, 2).unwrap();
        let mut grey = vec![0u8; 20];
        (grey[0], grey[9], grey[10]) = (0x80, 0xff, 0x41);
        assert_eq!(planes_of(&grey, raster, 1), [vec![0x80, 0x40, 0, 0]]);
        // Bits 6 and 7: 0x41 has bit 6, 0x80 bit 7, 0xff both.
        assert_eq!(planes_of(&grey, raster, 2), [vec![0, 0x40, 0x80, 0], vec![0x80, 0x40, 0, 0]]);
        let all = planes_of(&grey, raster, 8);
        for (i, g) in grey.iter().enumerate() {
            let (x, y) = (i % 10, i / 10);
            let bit = |b: usize| all[b][y * 2 + x / 8] >> (7 - x % 8) & 1;
            assert_eq!((0..8).map(|b| bit(b) << b).sum::<u8>(), *g);
        }
    }

    #[test]
    fn a_picture_of_another_size_is_named_with_both_sizes() {
        let folder = std::env::temp_dir().join(format!("dpm-dlpc900-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("small.png");
        image::GrayImage::new(64, 48).save(&file).unwrap();
        let show = ShowAs {
            depth: 1,
            exposure_us: None,
            dark_us: 0,
            leds: 7,
            wait_trigger: false,
            repeat: Repeat::Forever,
            order: PlaneOrder::default(),
            compression: None,
        };
        let err = sequence_of(std::slice::from_ref(&file), Dmd::Dlp6500, &show).unwrap_err().to_string();
        assert!(
            err.ends_with("small.png: 64 x 48 pixels, the DLP6500 has 1920 x 1080: scale the picture"),
            "{err}"
        );
        std::fs::write(&file, b"not a picture").unwrap();
        assert!(matches!(read_grey(&file, Dmd::Dlp6500), Err(PatternFileError::Read { .. })));
        // The first bytes of OpenEXR.
        std::fs::write(&file, [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0]).unwrap();
        let told = read_grey(&file, Dmd::Dlp6500).unwrap_err().to_string();
        assert!(told.contains("small.png"), "{told}");
        assert_eq!(told.ends_with(NO_OPENEXR), !ImageFormat::OpenExr.reading_enabled(), "{told}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
