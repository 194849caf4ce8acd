//! What a frame might take on GPUs that are not there: counts of this machine over rates that a measured card was found to have.
//!
//! **Nothing here is measured on the GPU that a row names.** The counts (rays, those of them that horizons prove to miss, bytes, passes) are
//! exact for the frames that `dpm bench` drew. Times come from them in two ways, which stand side by side:
//!
//! - **By instructions**: a walk is so many steps of a warp (simulated on real scans with warps of 32 lanes), a step is so many
//!   instructions (compiled for sm_90), and a multiprocessor issues so many in a second. Three numbers were fitted to frames of an H100
//!   and an H200 (`host/lab/cards/`): the share of the issue rate that walks reach, what every `trace` takes however few rays it has, and
//!   the share of the memory's peak that passes over pixels reach. The range of a time is what those frames were of the fit.
//! - **By assumed rays a second**, written down before any card was measured, and wrong: an H100 took twice the time. It stays as it was,
//!   so that whoever measures another card sees which of the two fails there.
//!
//! [docs/lab/GPU-MODEL.md](../../../docs/lab/GPU-MODEL.md) has both, and where the fit is wrong.

use crate::lanes::Lanes;
use serde::Serialize;

/// Share of the memory's peak rate that a pass over pixels was assumed to reach.
const ASSUMED_BANDWIDTH_SHARE: f64 = 0.6;
/// PCIe 4.0 with 16 lanes, as copies reach it, bytes per second: assumed for every card.
const ASSUMED_BUS_BYTES_PER_S: f64 = 25e9;
/// What a barrier between two passes costs, milliseconds: assumed, and what an H100 took for a pass without work.
const BARRIER_MS: f64 = 0.005;

/// Instructions of a warp in a step through nodes, in a triangle test and in a round of the walk, compiled for sm_90.
const STEP_INSTRUCTIONS: [f64; 3] = [310.0, 127.0, 140.0];
/// Those of shading a warp's vertices, by the rays that a vertex asks for.
const SHADING_INSTRUCTIONS: f64 = 44.0;
/// Steps of a warp (nodes, triangle tests, rounds) by the rays of its lanes, simulated at these shares of walked rays; two rays a vertex.
const STEPS: [(f64, [f64; 3]); 4] = [
    (0.0, [0.0, 0.0, 0.0]),
    (0.165, [0.671, 0.623, 0.253]),
    (0.305, [0.760, 0.746, 0.280]),
    (1.0, [0.963, 1.035, 0.340]),
];
/// Rays of a path in that simulation, and in one without rays to lights, which needs more instructions a ray by this factor.
const RAYS_A_PATH: [f64; 2] = [2.13, 1.04];
const WITHOUT_LIGHT_RAYS: f64 = 515.0 / 415.0;
/// Instructions of a warp for the ray of a listed pixel from the projector, and from there to the eye, and clocks that `primary` takes beside
/// them: fitted to an H100, 0.162 ms for 219,392 pixels and 0.225 ms for 442,368.
const CAMERA_INSTRUCTIONS: f64 = 200.0;
const CAMERA_TAIL_CLOCKS: f64 = 0.1e-3 * 1.98e9;

/// Share of the issue rate that `primary` and `trace` reach: fitted.
const ISSUE_SHARE: f64 = 0.68;
/// Clocks that `trace` takes beside its rays, until the longest path has ended: fitted, 0.19 ms at 1.98 GHz.
const TAIL_CLOCKS: f64 = 0.19e-3 * 1.98e9;
/// Share of the memory's peak rate that passes over pixels reach: fitted, 220 MB in 0.231 ms of an H100's 3.35 TB/s.
const BANDWIDTH_SHARE: f64 = 0.284;
/// What measured frames took of the fitted `trace`, least and most.
const SPREAD: [f64; 2] = [0.9, 1.25];

/// What was counted of a frame.
#[derive(Clone, Debug, Serialize)]
pub struct FrameWork {
    /// How evenly the samples lay on lanes of each of [`crate::lanes::WIDTHS`].
    pub lanes: Vec<Lanes>,
    /// Pixels of the tiles that the frame worked on.
    pub listed_pixels: u64,
    /// Samples, each of which begins a path.
    pub paths: u64,
    /// Rays of the paths: all but the camera's.
    pub path_rays: u64,
    /// Those of them that the horizons of a GPU prove to meet nothing.
    pub proven_rays: u64,
    /// Bytes that the recorded passes move for each of these pixels.
    pub bytes_per_pixel: f64,
    /// Passes that are recorded; a barrier follows each.
    pub recorded_passes: u32,
    /// Bytes of a frame that the host reads.
    pub readback_bytes: u64,
}

/// A GPU by what its maker says of it, and by what was assumed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct GpuCard {
    name: &'static str,
    /// Schedulers, each of which issues an instruction for 32 lanes in a clock.
    schedulers: f64,
    /// Clock under load, Hz.
    clock_hz: f64,
    /// Instructions of its compiler by those of sm_90.
    code: f64,
    /// Rate of copies over its bus, bytes per second: measured of the H200, else that of PCIe 4.0.
    bus_bytes_per_s: f64,
    /// Peak rate of its memory by its maker, bytes per second.
    memory_bytes_per_s: f64,
    /// Incoherent rays a second in a compute kernel, least and most: assumed.
    assumed_rays_per_s: [f64; 2],
    /// Lanes of a subgroup in this program's kernels.
    width: usize,
}

/// The chip that was measured stands last.
const CARDS: [GpuCard; 4] = [
    GpuCard {
        name: "RTX 4090",
        schedulers: 128.0 * 4.0,
        clock_hz: 2.52e9,
        code: 1.0,
        bus_bytes_per_s: ASSUMED_BUS_BYTES_PER_S,
        memory_bytes_per_s: 1008e9,
        assumed_rays_per_s: [3e9, 4e9],
        width: 32,
    },
    GpuCard {
        name: "RX 7900 XTX",
        schedulers: 96.0 * 2.0,
        clock_hz: 2.4e9,
        code: 0.8,
        bus_bytes_per_s: ASSUMED_BUS_BYTES_PER_S,
        memory_bytes_per_s: 960e9,
        assumed_rays_per_s: [1.5e9, 2e9],
        width: 64,
    },
    GpuCard {
        name: "RTX 4060 laptop",
        schedulers: 24.0 * 4.0,
        clock_hz: 1.92e9,
        code: 1.0,
        bus_bytes_per_s: ASSUMED_BUS_BYTES_PER_S,
        memory_bytes_per_s: 256e9,
        assumed_rays_per_s: [0.5e9, 0.7e9],
        width: 32,
    },
    GpuCard {
        name: "H200",
        schedulers: 132.0 * 4.0,
        clock_hz: 1.98e9,
        code: 1.0,
        bus_bytes_per_s: 46e9,
        memory_bytes_per_s: 4800e9,
        assumed_rays_per_s: [2.5e9, 3.5e9],
        width: 32,
    },
];

/// What a method's frame might take on a GPU by the fit, milliseconds, with each term. Two values are the least and the most.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Modelled {
    /// Name of the GPU.
    pub gpu: &'static str,
    /// Name of the method.
    pub method: &'static str,
    /// Camera rays and those of paths, by instructions.
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
    /// The same by rates that were assumed and that failed where a card was measured.
    pub failed_assumption: RateAssumption,
}

/// A frame by the assumptions that stood here before a card was measured, milliseconds, least and most.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RateAssumption {
    /// All rays over rate and busy lanes.
    pub trace_ms: [f64; 2],
    /// The whole frame.
    pub frame_ms: [f64; 2],
}

/// A method, its rays of a frame, and the frame's counts.
pub(crate) type CountedFrame<'a> = (&'static str, f64, &'a FrameWork);

/// The model for every card and every method that was measured.
pub(crate) fn modelled<'a>(each: impl Iterator<Item = CountedFrame<'a>> + Clone) -> Vec<Modelled> {
    CARDS.iter().flat_map(|card| each.clone().filter_map(|method| on(card, method))).collect()
}

/// Instructions of a warp for each ray of a path, shading included. `walked`: share of the rays that are walked; `rays_a_path`: of a path.
pub(crate) fn instructions_a_ray(walked: f64, rays_a_path: f64) -> f64 {
    let walked = walked.clamp(0.0, 1.0);
    let above = STEPS.iter().position(|(share, _)| *share >= walked).unwrap_or(STEPS.len() - 1).max(1);
    let ((low, a), (high, b)) = (STEPS[above - 1], STEPS[above]);
    let t = (walked - low) / (high - low);
    let steps = (0..3).map(|i| STEP_INSTRUCTIONS[i] * (a[i] + t * (b[i] - a[i]))).sum::<f64>();
    let [with_lights, without] = RAYS_A_PATH;
    let missing = ((with_lights - rays_a_path) / (with_lights - without)).clamp(0.0, 1.0);
    (steps + SHADING_INSTRUCTIONS) * (1.0 + missing * (WITHOUT_LIGHT_RAYS - 1.0))
}

impl GpuCard {
    /// The chip of the H100 and the H200, whose clocks and schedulers are the same.
    #[cfg(test)]
    pub(crate) fn measured_chip() -> Self {
        CARDS[CARDS.len() - 1]
    }

    /// Milliseconds in which so many instructions of warps are issued.
    fn issue_ms(&self, instructions: f64) -> f64 {
        1e3 * instructions * self.code / (ISSUE_SHARE * self.schedulers * self.clock_hz)
    }

    /// The pass `trace` by the fit, ms; 0 without rays.
    pub(crate) fn trace_ms(&self, path_rays: f64, walked: f64, rays_a_path: f64) -> f64 {
        if path_rays <= 0.0 {
            return 0.0;
        }
        1e3 * TAIL_CLOCKS / self.clock_hz + self.issue_ms(path_rays * instructions_a_ray(walked, rays_a_path))
    }
}

/// `None` for a method that traced nothing.
fn on(card: &GpuCard, (method, rays, work): CountedFrame<'_>) -> Option<Modelled> {
    let lanes = work.lanes.iter().find(|lanes| lanes.width == card.width)?;
    let rays_of_paths = work.path_rays as f64;
    let walked = 1.0 - work.proven_rays as f64 / rays_of_paths.max(1.0);
    let camera = 1e3 * CAMERA_TAIL_CLOCKS / card.clock_hz
        + card.issue_ms(work.listed_pixels as f64 * CAMERA_INSTRUCTIONS);
    let paths = card.trace_ms(rays_of_paths, walked, rays_of_paths / work.paths.max(1) as f64);
    let trace_ms = SPREAD.map(|of_fit| camera + of_fit * paths);
    let bytes = work.listed_pixels as f64 * work.bytes_per_pixel;
    let screen_by = |share: f64| 1e3 * bytes / (share * card.memory_bytes_per_s);
    let barriers_ms = BARRIER_MS * f64::from(work.recorded_passes);
    let readback_by = |rate: f64| 1e3 * work.readback_bytes as f64 / rate;
    let (screen_ms, readback_ms) = (screen_by(BANDWIDTH_SHARE), readback_by(card.bus_bytes_per_s));
    let frame_ms = trace_ms.map(|trace| trace + screen_ms + barriers_ms + readback_ms);
    let frames_per_s = [1e3 / frame_ms[1], 1e3 / frame_ms[0]];
    let [least, most] = card.assumed_rays_per_s;
    let assumed = [most, least].map(|rate| 1e3 * rays / (rate * lanes.busy));
    let others = screen_by(ASSUMED_BANDWIDTH_SHARE) + barriers_ms + readback_by(ASSUMED_BUS_BYTES_PER_S);
    let failed_assumption =
        RateAssumption { trace_ms: assumed, frame_ms: assumed.map(|trace| trace + others) };
    let gpu = card.name;
    Some(Modelled {
        gpu,
        method,
        trace_ms,
        screen_ms,
        barriers_ms,
        readback_ms,
        frame_ms,
        frames_per_s,
        failed_assumption,
    })
}

/// The model as a table, under a heading that says what it is.
pub fn table(rows: &[Modelled]) -> String {
    let mut text = String::from(
        "computed, not measured on these GPUs: ms a frame by counts of instructions, fitted to an H100 and an H200 (docs/lab/GPU-MODEL.md);\n\
         last what was assumed before they were measured, which was half of what they took\n\
         GPU              method       trace, least to most   screen  barriers  read back   frame, least to most  frames/s      assumed, and failed\n",
    );
    for r in rows {
        let ([least, most], [assumed_least, assumed_most]) = (r.frame_ms, r.failed_assumption.frame_ms);
        text += &format!(
            "{:<16} {:<9} {:>10.3} to {:<10.3} {:>8.3} {:>9.3} {:>10.3} {:>10.3} to {:<8.3} {:>5.0} to {:<5.0} {:>10.3} to {:<8.3}\n",
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
            r.frames_per_s[1],
            assumed_least,
            assumed_most
        );
    }
    text
}

#[cfg(test)]
mod tests;
