//! What a frame might take on GPUs that are not there: counts of this machine over published and estimated rates.
//!
//! **Nothing here is measured on a GPU.** The counts (rays, lanes, bytes, barriers) are exact for the frames that
//! `dpm bench` drew. What a GPU does in a second is an assumption, written down below before any of this was computed,
//! and each term of the sum is told apart, so that whoever measures a card sees which assumption was wrong.
//!
//! - A ray is an incoherent one in a compute kernel, into 90,000 triangles. No card has published a figure for this
//!   walk; the ranges are estimates from published figures of other tracers on the same cards.
//! - Lanes that wait for their subgroup's longest thread trace nothing: the rate is divided by the share of busy lanes.
//!   That walks diverge, and that few waves are resident, is in the range of the rate.
//! - The passes over pixels move their bytes at `BANDWIDTH_SHARE` of the memory's peak. Caches save some of that.
//! - Each barrier drains the machine once. The planes cross the bus at `BUS_BYTES_PER_S`, after the frame.

use crate::lanes::Lanes;
use serde::Serialize;

/// Share of the memory's peak rate that a pass over pixels reaches.
const BANDWIDTH_SHARE: f64 = 0.6;
/// PCIe 4.0 with 16 lanes, as copies reach it, bytes per second.
const BUS_BYTES_PER_S: f64 = 25e9;
/// What a barrier between two passes costs, milliseconds.
const BARRIER_MS: f64 = 0.005;

/// What was counted of a frame.
#[derive(Clone, Debug, Serialize)]
pub struct FrameWork {
    /// How evenly the samples lay on lanes of each of [`crate::lanes::WIDTHS`].
    pub lanes: Vec<Lanes>,
    /// Pixels of the tiles that the frame worked on.
    pub listed_pixels: u64,
    /// Bytes that the recorded passes move for each of these pixels.
    pub bytes_per_pixel: f64,
    /// Passes that are recorded; a barrier follows each.
    pub recorded_passes: u32,
    /// Bytes of a frame that the host reads.
    pub readback_bytes: u64,
}

/// A GPU by its assumptions.
#[derive(Clone, Copy, Debug)]
struct Card {
    name: &'static str,
    /// Incoherent rays a second in a compute kernel, least and most.
    rays_per_s: [f64; 2],
    /// Peak rate of its memory by its maker, bytes per second.
    memory_bytes_per_s: f64,
    /// Lanes of a subgroup in this program's kernels.
    width: usize,
}

const CARDS: [Card; 4] = [
    Card { name: "RTX 4090", rays_per_s: [3e9, 4e9], memory_bytes_per_s: 1008e9, width: 32 },
    Card { name: "RX 7900 XTX", rays_per_s: [1.5e9, 2e9], memory_bytes_per_s: 960e9, width: 64 },
    Card { name: "RTX 4060 laptop", rays_per_s: [0.5e9, 0.7e9], memory_bytes_per_s: 256e9, width: 32 },
    Card { name: "H200", rays_per_s: [2.5e9, 3.5e9], memory_bytes_per_s: 4800e9, width: 32 },
];

/// What a method's frame might take on a GPU, milliseconds, with each term. Two values are the least and the most.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Modelled {
    /// Name of the GPU.
    pub gpu: &'static str,
    /// Name of the method.
    pub method: &'static str,
    /// Rays over rate and busy lanes.
    pub trace_ms: [f64; 2],
    /// Bytes of the passes over pixels.
    pub screen_ms: f64,
    /// Barriers.
    pub barriers_ms: f64,
    /// Planes over the bus.
    pub readback_ms: f64,
    /// All of it, one after the other.
    pub frame_ms: [f64; 2],
    /// Frames per second that this allows.
    pub frames_per_s: [f64; 2],
}

/// The model for every card and every method: its name, rays a frame, and what was counted.
pub fn modelled<'a>(
    methods: impl Iterator<Item = (&'static str, f64, &'a FrameWork)> + Clone,
) -> Vec<Modelled> {
    CARDS.iter().flat_map(|card| methods.clone().filter_map(|method| on(card, method))).collect()
}

/// `None` for a method that traced nothing.
fn on(card: &Card, (method, rays, work): (&'static str, f64, &FrameWork)) -> Option<Modelled> {
    let lanes = work.lanes.iter().find(|lanes| lanes.width == card.width)?;
    let trace = |rate: f64| 1e3 * rays / (rate * lanes.busy);
    let [least, most] = card.rays_per_s;
    let trace_ms = [trace(most), trace(least)];
    let screen_ms =
        1e3 * work.listed_pixels as f64 * work.bytes_per_pixel / (BANDWIDTH_SHARE * card.memory_bytes_per_s);
    let barriers_ms = BARRIER_MS * f64::from(work.recorded_passes);
    let readback_ms = 1e3 * work.readback_bytes as f64 / BUS_BYTES_PER_S;
    let frame_ms = trace_ms.map(|trace| trace + screen_ms + barriers_ms + readback_ms);
    let frames_per_s = [1e3 / frame_ms[1], 1e3 / frame_ms[0]];
    let gpu = card.name;
    Some(Modelled { gpu, method, trace_ms, screen_ms, barriers_ms, readback_ms, frame_ms, frames_per_s })
}

/// The model as a table, under a heading that says what it is.
pub fn table(rows: &[Modelled]) -> String {
    let mut text = String::from(
        "computed, not measured: ms a frame by the assumptions of host/lab/src/gpu_model.rs\n\
         GPU              method       trace, least to most   screen  barriers  read back   frame, least to most  frames/s\n",
    );
    for r in rows {
        let [least, most] = r.frame_ms;
        text += &format!(
            "{:<16} {:<9} {:>10.3} to {:<10.3} {:>8.3} {:>9.3} {:>10.3} {:>10.3} to {:<8.3} {:>5.0} to {:<5.0}\n",
            r.gpu,
            r.method,
            r.trace_ms[0],
            r.trace_ms[1],
            r.screen_ms,
            r.barriers_ms,
            r.readback_ms,
            least,
            most,
            r.frames_per_s[0],
            r.frames_per_s[1]
        );
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    fn work() -> FrameWork {
        let lanes = |width, busy| Lanes { width, busy, longest: 8 };
        FrameWork {
            lanes: vec![lanes(32, 0.5), lanes(64, 0.25)],
            listed_pixels: 300_000,
            bytes_per_pixel: 1000.0,
            recorded_passes: 10,
            readback_bytes: 2_500_000,
        }
    }

    #[test]
    fn each_term_is_its_count_over_its_rate() {
        let work = work();
        let rows = modelled([("dpm", 3e6, &work)].into_iter());
        assert_eq!(rows.len(), CARDS.len());
        let near = |a: f64, b: f64| (a - b).abs() < 1e-9 * b.abs().max(1.0);
        let r = &rows[0];
        assert!(r.gpu == "RTX 4090" && near(r.trace_ms[0], 1.5) && near(r.trace_ms[1], 2.0), "{r:?}");
        assert!(near(r.screen_ms, 1e3 * 3e8 / 604.8e9) && near(r.barriers_ms, 0.05), "{r:?}");
        assert!(near(r.readback_ms, 0.1), "{r:?}");
        let [least, most] = r.frame_ms;
        assert!(near(least, 1.65 + r.screen_ms) && near(most, 2.15 + r.screen_ms), "{r:?}");
        assert!(near(r.frames_per_s[0], 1e3 / most) && near(r.frames_per_s[1], 1e3 / least), "{r:?}");
        // A card with wide subgroups loses more to uneven work.
        assert!(rows[1].gpu == "RX 7900 XTX" && near(rows[1].trace_ms[0], 6.0), "{:?}", rows[1]);
        assert!(table(&rows).starts_with("computed, not measured"));
        let none = FrameWork { lanes: vec![], ..work };
        assert!(modelled([("dpm", 3e6, &none)].into_iter()).is_empty());
    }
}
