//! `[render]`, `[real_time]`, `[run]` and `[output]`: how the picture is made and how the program behaves.

use super::values::RenderScale;
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::{section, words};
use dpm_device::planes::Raster;
use std::path::PathBuf;
use std::time::Duration;

section! {
    /// How radiance is computed.
    pub struct RenderConfig {
        /// Which method allocates the rays; `effects` can switch each of its parts.
        method: RenderMethod = RenderMethod::Dpm, "", Any;
        /// Samples per pixel where no angle-dependent count applies.
        spp: u32 = 2, "samples/px", Within(1, 4096);
        /// Largest average of samples per pixel in a run, with `method = "dpm"`. If left out, `spp` alone bounds it.
        budget_spp: Option<f64> = None, "samples/px", Within(0.125, 4096.0);
        /// Closest-hit rays per path: 1 shows emission only, 2 direct light, 3 one bounce.
        depth: u32 = 3, "", Within(1, 64);
        /// Raster that is traced and projected instead of the mock projector's if only software Vulkan is available.
        /// `--raster` sets it.
        software_raster: [u32; 2] = [320, 240], "px", Within(1, Raster::MAX_SIDE);
        /// Share of the projector's columns and rows that is traced (docs/RENDERING.md). A quarter costs about a
        /// sixteenth of the rays. "auto" takes the largest of 1, 0.75, 0.5, 0.35 and 0.25 whose frames fit their slots
        /// on this device; only at real pace.
        scale: RenderScale = RenderScale::Share(1.0), "", Within(0.25, 1.0);
        /// Factor by which radiance is multiplied before it becomes light.
        exposure: f64 = 1.0, "", Within(1e-6, 1e6);
        /// White balance: how much red, green and blue the scene's white has. Lower a channel in which white surfaces
        /// look tinted.
        white: [f64; 3] = [1.0, 1.0, 1.0], "", Within(1e-3, 1e3);
        /// Seed of all random numbers of the picture.
        seed: u64 = 1, "", Any;
        /// Largest luminance of a contribution after the second vertex; 0 is off. Removes fireflies at the cost of
        /// energy.
        clamp_indirect: f64 = 0.0, "scene units", Within(0.0, 1e9);
        /// The Vulkan device: its number in `dpm doctor` or a part of its name; the fastest kind if left out.
        gpu: Option<String> = None, "", NotEmpty;
        /// Whether a GPU with two queues begins a frame while the one before it ends, for frames that take about a slot
        /// or more.
        overlap: bool = true, "", Any;
        /// Who finds what a ray meets. The pictures are the same, but for surfaces that are equally near.
        tracing: Tracing = Tracing::Auto, "", Any;
        /// Which processor packs the picture into bit planes.
        packer: Packer = Packer::Auto, "", Any;
        /// Constants of the paper.
        paper: PaperConfig = PaperConfig::default(), "", Any;
        /// Parts of the method; a part that is left out is as the method defines it.
        effects: EffectsConfig = EffectsConfig::default(), "", Any;
    }
}

words! {
    /// Methods of allocating rays.
    pub enum RenderMethod {
        /// This program's own: the paper's method with its open questions answered.
        Dpm = "dpm",
        /// The paper's method.
        Paper = "paper",
        /// \[Miyamoto22\], the second reference of \[paper\]: no shading rates, no spatial filter.
        Miyamoto = "miyamoto",
        /// Every pixel in every frame, independent samples, nothing reused.
        Full = "full",
        /// Every pixel in every frame, nothing reused; each pixel continues one low-discrepancy sequence from frame
        /// to frame.
        Sequence = "sequence",
        /// The frame's own samples of the sequences that method `dpm` carries with surface points, as many in every pixel.
        /// No light is kept and nothing is filtered, so it has no bias.
        Own = "own",
        /// The one of these that `dpm plan --measure` found to err least on this device in the time of a frame of `dpm`.
        Auto = "auto",
    }
}

section! {
    /// The paper's constants. Angles are measured at the eye, from the gaze.
    pub struct PaperConfig {
        /// Sensitivity threshold of equation 2.
        t: f64 = 0.0762, "", Within(0.0, 10.0);
        /// Background luminance of equation 2.
        l: f64 = 0.363, "scene units", Within(0.0, 1e6);
        /// Full rate up to this angle, equation 4; also the inner bound of table 1.
        phi_h_deg: f64 = 15.0, "deg", Within(0.0, 180.0);
        /// Quarter rate from this angle, equation 4; also the outer bound of table 1.
        phi_q_deg: f64 = 30.0, "deg", Within(0.0, 180.0);
        /// Table 1: weight of the new frame inside phi_h, between, and outside phi_q.
        temporal_alpha: [f64; 3] = [0.2, 0.1, 0.05], "", Within(0.001, 1.0);
        /// Table 1: samples per pixel in the same three zones.
        zone_spp: [u32; 3] = [18, 18, 2], "samples/px", Within(1, 4096);
        /// Angle at which the spatial filter begins to blend in.
        filter_from_deg: f64 = 15.0, "deg", Within(0.0, 180.0);
        /// Angle at which the spatial filter is fully blended in.
        filter_to_deg: f64 = 18.0, "deg", Within(0.0, 180.0);
    }
}

section! {
    /// Switches for the method's parts.
    pub struct EffectsConfig {
        /// Variable rate shading from scene information and visual field.
        rate_map: Option<bool> = None, "", Any;
        /// Every second block in every second frame.
        checkerboard: Option<bool> = None, "", Any;
        /// Evenly spread samples (blue noise, or a continuing sequence) instead of independent ones.
        blue_noise: Option<bool> = None, "", Any;
        /// Reuse of previous frames.
        temporal_filter: Option<bool> = None, "", Any;
        /// Poisson-disk filter in the periphery.
        spatial_filter: Option<bool> = None, "", Any;
        /// Samples by angle from the gaze.
        spp_by_angle: Option<bool> = None, "", Any;
    }
}

/// The switches with the method's own settings filled in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Effects {
    /// Variable rate shading.
    pub rate_map: bool,
    /// Every second block in every second frame.
    pub checkerboard: bool,
    /// Blue-noise sample offsets.
    pub blue_noise: bool,
    /// Reuse of previous frames.
    pub temporal_filter: bool,
    /// Poisson-disk filter in the periphery.
    pub spatial_filter: bool,
    /// Samples by angle from the gaze.
    pub spp_by_angle: bool,
}

impl RenderConfig {
    /// The parts of the method that are on.
    pub fn effects_on(&self) -> Effects {
        let (shared, own, even_samples) = match self.method {
            RenderMethod::Dpm | RenderMethod::Auto | RenderMethod::Paper => (true, true, true),
            RenderMethod::Miyamoto => (true, false, true),
            RenderMethod::Sequence | RenderMethod::Own => (false, false, true),
            RenderMethod::Full => (false, false, false),
        };
        let e = &self.effects;
        Effects {
            rate_map: e.rate_map.unwrap_or(own),
            checkerboard: e.checkerboard.unwrap_or(shared),
            blue_noise: e.blue_noise.unwrap_or(even_samples),
            temporal_filter: e.temporal_filter.unwrap_or(shared),
            spatial_filter: e.spatial_filter.unwrap_or(own),
            spp_by_angle: e.spp_by_angle.unwrap_or(shared),
        }
    }
}

words! {
    /// Who finds what a ray meets.
    pub enum Tracing {
        /// The GPU itself where its driver has ray queries, else the shaders; with software Vulkan the shaders.
        Auto = "auto",
        /// The shaders, which walk through the program's own trees.
        Walk = "walk",
        /// The device by ray queries, software or not. A device without them is refused. Where meshes deform, the shaders walk.
        Query = "query",
        /// On software Vulkan threads of the host, between the shaders' dispatches; for scenes without holes, veils and meshes that deform. It takes
        /// some seconds more to start. Elsewhere as "auto".
        Host = "host",
    }
}

words! {
    /// Which processor packs the picture into bit planes; the bytes are the same.
    pub enum Packer {
        /// The GPU, or the CPU if Vulkan is software.
        Auto = "auto",
        /// The GPU, software or not.
        Gpu = "gpu",
        /// The CPU's vector units.
        Cpu = "cpu",
    }
}

words! {
    /// Which clock the run uses.
    pub enum Pace {
        /// The wall clock.
        Real = "real",
        /// The rig's own clock, which advances one slot per frame: deterministic, and for machines that are too slow
        /// for the rate.
        Virtual = "virtual",
    }
}

words! {
    /// How a thread waits for the next piece of work.
    pub enum Wait {
        /// Spins: the shortest hand-off, but occupies a core.
        Spin = "spin",
        /// Sleeps, and leaves the core to other threads.
        Park = "park",
        /// Spins if there are enough cores, else parks.
        Auto = "auto",
    }
}

section! {
    /// Pace and rights from the operating system.
    pub struct RealTimeConfig {
        /// "real" for rigs, "virtual" for repeatable results.
        pace: Pace = Pace::Real, "", Any;
        /// SCHED_FIFO priority of the frame path; 0 keeps the normal scheduler. If the right is refused, the run
        /// warns once.
        priority: u32 = 50, "", Within(0, 99);
        /// Cores for the frame path's threads, in the order of the stages; an empty list leaves the choice to the
        /// kernel.
        affinity: Vec<u32> = Vec::new(), "", Any;
        /// Keep all memory resident, so that no page fault delays a frame.
        lock_memory: bool = false, "", Any;
        /// Keep idle cores of this machine from deep sleep while the rig runs, so that a stage that waits starts
        /// within microseconds. It costs power.
        keep_awake: bool = true, "", Any;
        /// How stages wait for each other.
        wait: Wait = Wait::Auto, "", Any;
        /// Assumed cost of each stage at virtual pace.
        stage_costs_us: StageCostsConfig = StageCostsConfig::default(), "", Any;
    }
}

section! {
    /// Modelled cost of each stage at virtual pace. Together with the tracker's latency they make up the
    /// motion-to-light latency.
    pub struct StageCostsConfig {
        /// From sample to pose.
        track: u32 = 20, "us", Within(0, 1_000_000);
        /// From pose to plan.
        plan: u32 = 20, "us", Within(0, 1_000_000);
        /// From plan to radiance.
        render: u32 = 900, "us", Within(0, 1_000_000);
        /// From radiance to bit planes.
        pack: u32 = 300, "us", Within(0, 1_000_000);
        /// From bit planes to the device.
        send: u32 = 1_000, "us", Within(0, 1_000_000);
    }
}

impl StageCostsConfig {
    /// Sum of the stages from plan to send, us: the time that a frame needs from latch to light.
    pub fn total(&self) -> u32 {
        self.plan + self.render + self.pack + self.send
    }
}

section! {
    /// How long to run.
    pub struct RunConfig {
        /// Frames to light; 0 runs until stopped.
        frames: u64 = 0, "frames", Any;
        /// Duration in seconds from the first frame, of the wall clock at real pace, of the rig's own clock at virtual
        /// pace; 0 is no limit.
        seconds: f64 = 0.0, "s", Within(0.0, 1e9);
    }
}

section! {
    /// Which files are written.
    pub struct OutputConfig {
        /// Folder for images, report and trace, relative to the working directory.
        dir: PathBuf = PathBuf::from("out/run"), "", NotEmpty;
        /// Write `light.png` and `viewer.png` at the end.
        images: bool = false, "", Any;
        /// Write a Chrome trace of every frame.
        trace: bool = false, "", Any;
        /// Record what every stage did around each missed slot, from two seconds before it: a trace `flight-NN.json`
        /// and a page `flight-NN.txt` in `dir`, 32 of each at most.
        flight_recorder: bool = false, "", Any;
        /// How often a run without a terminal writes its progress as one line of JSON to the standard error stream; 0
        /// is never.
        log_every_s: f64 = 1.0, "s", Within(0.0, 86_400.0);
        /// Time over which the images integrate light, as an eye does. If left out, it is the longer of 33 ms and
        /// one frame.
        light_window_ms: Option<f64> = None, "ms", Within(0.01, 10_000.0);
    }
}

impl OutputConfig {
    /// How often progress is written without a terminal; `None` for never.
    pub fn log_every(&self) -> Option<Duration> {
        (self.log_every_s > 0.0).then(|| Duration::from_secs_f64(self.log_every_s))
    }
}
