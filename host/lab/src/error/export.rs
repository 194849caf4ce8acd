//! A measured group into frames on disk: what the eye saw of every method and what it should have seen, for metrics of others.
//!
//! The pictures are of the surfaces, not of the raster: every lit point stands at its place of the last frame, so an eye that follows the
//! bodies sees them like this. What is not lit, in the sequence of a method and in the reference alike, is black.
//!
//! Every sequence begins with the reference's first frame. A metric has to take something for what was before the beginning, and most take
//! the first frame, as if it had stood there for ever: with a method's own, one frame's noise, which no eye ever sees by itself at such
//! rates, would be judged for a quarter of a second.

use super::plan::file_word;
use super::runs::{ErrorRunError, ErrorRuns, GroupResult};
use crate::metrics::white_of;
use crate::sequence::Theatre;
use crate::snapshot::pfm;
use crate::stamp::Stamp;
use dpm_common::files::write_atomically;
use dpm_render::method::{Method, SamplerKind};
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::Path;

/// The frames of one method.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MethodFrames {
    /// Method.
    pub method: String,
    /// Its folder beside the index: `0000.pfm` is the first frame, of the lead-in.
    pub folder: String,
    /// RMSE of what the eye sees, as measured from both runs; the first of them is what lies in the folder.
    pub perceived_rmse: f64,
}

/// What `sequence.json` says about the frames beside it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct FrameIndex {
    /// With what.
    pub stamp: Stamp,
    /// The group.
    pub group: String,
    /// Frames a second.
    pub frame_rate_hz: f64,
    /// Frames in each folder, those of the lead-in included.
    pub frames: u32,
    /// So many at the beginning of every folder are the reference's first frame.
    pub lead_in: u32,
    /// Columns and rows.
    pub raster: [u32; 2],
    /// Pixels in a degree of the observer's view.
    pub pixels_per_degree: f64,
    /// Radiance in the frames' unit that a metric should take for white: the brightest hundredth of the reference begins there.
    pub white: f64,
    /// Folder of the reference.
    pub reference: String,
    /// One a method.
    pub methods: Vec<MethodFrames>,
}

/// Frames of every sequence before its method begins.
const LEAD_IN: u32 = 1;

impl ErrorRuns {
    /// Draws the first run of every method of a measured group again, and the reference of every frame, and writes them below `dir`. The
    /// same seeds give the same frames as when they were measured. `each` is called before every sequence with its name.
    ///
    /// # Errors
    /// The renderer's; `dir` cannot be written.
    pub fn export(
        &self,
        result: &GroupResult,
        dir: &Path,
        each: &mut dyn FnMut(&str),
    ) -> Result<(), ErrorRunError> {
        let extent = self.options.extent;
        let reference = self.reference(each)?;
        let mut index = FrameIndex {
            stamp: self.stamp.clone(),
            group: self.setting.name(),
            frame_rate_hz: 1e9 / self.rig.rate().slot_len_ns(0).max(1) as f64,
            frames: LEAD_IN + extent.kept,
            lead_in: LEAD_IN,
            raster: self.stamp.raster,
            pixels_per_degree: 0.0,
            white: f64::from(white_of(&reference.eye)),
            reference: "reference".into(),
            methods: Vec::new(),
        };
        let theatre = self.theatre(extent.warm_up, extent.kept)?;
        index.pixels_per_degree = theatre.pixels_per_degree().unwrap_or(0.0);
        let truth = if self.setting.moving {
            let truth = self.theatre(0, extent.kept)?;
            let method = Method { sampler: SamplerKind::BlueNoise, ..Method::full(extent.reference_spp) };
            each("reference of every frame");
            truth.play(&method, extent.reference_spp as f32, 0x9e37_0002, &mut |_, _| ())?.frames
        } else {
            // Nothing moves: every frame should look as the last one does.
            vec![reference.eye; extent.kept as usize]
        };
        let before = truth.first().map_or(&[][..], Vec::as_slice);
        write_frames(&dir.join(&index.reference), &theatre, before, &truth)?;
        for (contender, row) in self.contenders().iter().zip(&result.rows) {
            each(contender.name);
            let seen =
                theatre.play(&contender.method, row.spp as f32, self.stamp.seed as u32, &mut |_, _| ())?;
            let folder = file_word(&row.method);
            write_frames(&dir.join(&folder), &theatre, before, &seen.frames)?;
            index.methods.push(MethodFrames {
                method: row.method.clone(),
                folder,
                perceived_rmse: row.perceived_rmse,
            });
        }
        let text = serde_json::to_vec_pretty(&index).map_err(std::io::Error::from)?;
        Ok(write_atomically(&dir.join("sequence.json"), |out| out.write_all(&text))?)
    }
}

/// Frames of probes as pictures of the raster, after a lead-in of `before`.
fn write_frames(dir: &Path, theatre: &Theatre, before: &[Vec3], frames: &[Vec<Vec3>]) -> std::io::Result<()> {
    let raster = theatre.raster();
    std::fs::create_dir_all(dir)?;
    let lead_in = (0..LEAD_IN).map(|_| before);
    for (k, frame) in lead_in.chain(frames.iter().map(Vec::as_slice)).enumerate() {
        let mut picture = vec![Vec3::ZERO; raster.pixel_count()];
        for (probe, v) in theatre.probes().iter().zip(frame).filter(|(_, v)| v.is_finite()) {
            picture[probe.pixel as usize] = *v;
        }
        let bytes = pfm(&picture, raster.width() as usize);
        // The index is written last: without it the frames count for nothing.
        std::fs::write(dir.join(format!("{k:04}.pfm")), bytes)?;
    }
    Ok(())
}
