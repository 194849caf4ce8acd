//! `[render]`, `[real_time]`, `[run]`, `[output]` and `[safety]`: how the picture is made and how the program behaves.

use super::safety::{InterlockConfig, LimitsConfig};
use dpm_common::keys::read::{Any, NotEmpty, Within};
use dpm_common::{section, words};
use dpm_device::planes::Raster;
use std::path::PathBuf;

section! {
    /// How radiance is found.
    pub struct RenderConfig {
        /// Which method spends the rays; `effects` can switch each part of it.
        method: RenderMethod = RenderMethod::Dpm, "", Any;
        /// Samples of a pixel where no angle-dependent count applies.
        spp: u32 = 2, "samples/px", Within(1, 4096);
        /// Closest-hit rays of a path: 1 sees emission only, 2 direct light, 3 one bounce.
        depth: u32 = 3, "", Within(1, 64);
        /// Raster traced and projected in place of the projector's when only software Vulkan is there. `--raster` sets it.
        software_raster: [u32; 2] = [320, 240], "px", Within(1, Raster::MAX_SIDE);
        /// Factor on radiance before it becomes light.
        exposure: f64 = 1.0, "", Within(1e-6, 1e6);
        /// Seed of all random numbers of the picture.
        seed: u64 = 1, "", Any;
        /// Largest luminance of a contribution after the second vertex; 0 is off. Removes fireflies at the cost of energy, which
        /// the report names.
        clamp_indirect: f64 = 0.0, "scene units", Within(0.0, 1e9);
        /// The Vulkan device: its number in `dpm doctor` or a part of its name; the fastest kind when left out.
        gpu: Option<String> = None, "", NotEmpty;
        /// Who cuts the picture into bit planes.
        packer: Packer = Packer::Auto, "", Any;
        /// Constants of the paper.
        paper: PaperConfig = PaperConfig::default(), "", Any;
        /// Parts of the method, each as the method has it when left out.
        effects: EffectsConfig = EffectsConfig::default(), "", Any;
    }
}

words! {
    /// Ways to spend rays.
    pub enum RenderMethod {
        /// This program's own: the paper's with its open questions answered.
        Dpm = "dpm",
        /// The paper's.
        Paper = "paper",
        /// \[Miyamoto22\], the second reference of \[paper\]: no shading rates, no spatial filter.
        Miyamoto = "miyamoto",
        /// Every pixel in every frame, independent samples, nothing reused.
        Full = "full",
        /// Every pixel in every frame, nothing reused; each pixel goes on with one low-discrepancy sequence from frame to frame.
        Sequence = "sequence",
    }
}

section! {
    /// The paper's constants; angles are measured at the eye from the gaze.
    pub struct PaperConfig {
        /// Sensitivity threshold of equation 2.
        t: f64 = 0.0762, "", Within(0.0, 10.0);
        /// Background luminance of equation 2.
        l: f64 = 0.363, "scene units", Within(0.0, 1e6);
        /// Full rate up to here, equation 4; also the inner bound of table 1.
        phi_h_deg: f64 = 15.0, "deg", Within(0.0, 180.0);
        /// Quarter rate from here, equation 4; also the outer bound of table 1.
        phi_q_deg: f64 = 30.0, "deg", Within(0.0, 180.0);
        /// Table 1: weight of the new frame inside phi_h, between, and outside phi_q.
        temporal_alpha: [f64; 3] = [0.2, 0.1, 0.05], "", Within(0.001, 1.0);
        /// Table 1: samples of a pixel in the same three zones.
        zone_spp: [u32; 3] = [18, 18, 2], "samples/px", Within(1, 4096);
        /// The spatial filter blends in from here ...
        filter_from_deg: f64 = 15.0, "deg", Within(0.0, 180.0);
        /// ... to here.
        filter_to_deg: f64 = 18.0, "deg", Within(0.0, 180.0);
    }
}

section! {
    /// Switches of the method's parts.
    pub struct EffectsConfig {
        /// Variable rate shading from scene information and visual field.
        rate_map: Option<bool> = None, "", Any;
        /// Every second block in every second frame.
        checkerboard: Option<bool> = None, "", Any;
        /// Evenly spread samples (blue noise, or a sequence that goes on) in place of independent ones.
        blue_noise: Option<bool> = None, "", Any;
        /// Reuse of former frames.
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
    /// Reuse of former frames.
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
            RenderMethod::Dpm | RenderMethod::Paper => (true, true, true),
            RenderMethod::Miyamoto => (true, false, true),
            RenderMethod::Sequence => (false, false, true),
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
    /// Who cuts the picture into bit planes; the bytes are the same.
    pub enum Packer {
        /// The GPU, or the CPU where Vulkan is software.
        Auto = "auto",
        /// The GPU, software or not.
        Gpu = "gpu",
        /// The CPU's vector units.
        Cpu = "cpu",
    }
}

words! {
    /// What time is.
    pub enum Pace {
        /// The wall clock: a slot lasts as long as it lasts.
        Real = "real",
        /// The rig's clock advances one slot a frame: deterministic, for machines too slow for the rate.
        Virtual = "virtual",
    }
}

words! {
    /// How a thread waits for the next piece of work.
    pub enum Wait {
        /// Burns its core: shortest hand-off.
        Spin = "spin",
        /// Sleeps: friendly to other threads.
        Park = "park",
        /// Spins when there are cores to spare, else parks.
        Auto = "auto",
    }
}

section! {
    /// Time and the operating system.
    pub struct RealTimeConfig {
        /// Real for rigs, virtual for results that repeat.
        pace: Pace = Pace::Real, "", Any;
        /// SCHED_FIFO priority of the frame path; 0 keeps the normal scheduler. Refused rights are one warning.
        priority: u32 = 50, "", Within(0, 99);
        /// Cores for the frame path's threads, in the order of the stages; empty leaves it to the kernel.
        affinity: Vec<u32> = Vec::new(), "", Any;
        /// Keep all memory resident, so that no page fault delays a frame.
        lock_memory: bool = false, "", Any;
        /// How stages wait for each other.
        wait: Wait = Wait::Auto, "", Any;
        /// What each stage is taken to cost at virtual pace.
        stage_costs_us: StageCostsConfig = StageCostsConfig::default(), "", Any;
    }
}

section! {
    /// Modelled cost of each stage at virtual pace. Together with the tracker's latency they are the motion-to-light latency.
    pub struct StageCostsConfig {
        /// Sample to pose.
        track: u32 = 20, "us", Within(0, 1_000_000);
        /// Pose to plan.
        plan: u32 = 20, "us", Within(0, 1_000_000);
        /// Plan to radiance.
        render: u32 = 900, "us", Within(0, 1_000_000);
        /// Radiance to bit planes.
        pack: u32 = 300, "us", Within(0, 1_000_000);
        /// Bit planes to the device.
        send: u32 = 1_000, "us", Within(0, 1_000_000);
    }
}

impl StageCostsConfig {
    /// All stages from plan to send together, us: what a frame needs from latch to light.
    pub fn total(&self) -> u32 {
        self.plan + self.render + self.pack + self.send
    }
}

section! {
    /// How long to run.
    pub struct RunConfig {
        /// Frames to light; 0 runs until it is told to stop.
        frames: u64 = 0, "frames", Any;
        /// Seconds to run for, counted from the first frame: of the wall clock at real pace, however many frames that makes, and of the rig's own clock at
        /// virtual pace; 0 is no limit.
        seconds: f64 = 0.0, "s", Within(0.0, 1e9);
    }
}

section! {
    /// What is written.
    pub struct OutputConfig {
        /// Folder for images, report and trace; relative to the working directory.
        dir: PathBuf = PathBuf::from("out/run"), "", NotEmpty;
        /// Write `light.png` and `viewer.png` at the end.
        images: bool = false, "", Any;
        /// Write a Chrome trace of every frame.
        trace: bool = false, "", Any;
        /// Time over which an eye adds up light in the images, at least a frame. Left out, it is 33 ms, or a frame where that is longer.
        light_window_ms: Option<f64> = None, "ms", Within(0.01, 10_000.0);
    }
}

section! {
    /// What happens when something fails.
    pub struct SafetyConfig {
        /// The projector goes dark by itself when it hears nothing for this long, at least two frames. Left out, it is 50 ms, or three frames
        /// where those are longer.
        watchdog_ms: Option<u32> = None, "ms", Within(1, 10_000);
        /// A body is carried on by prediction for at most this long after the tracker's newest sample of it, up to the middle of the light; then
        /// its light goes off. A frame that would be lit later than that and a slot is not sent. Left out, it follows the rig: the longer of
        /// 20 ms and the tracker's latency, two of its samples, the time from latch to light and two slots together. What is written is
        /// law: a rig whose frames take longer stays dark, and says so.
        predict_ms: Option<u32> = None, "ms", Within(0, 1_000);
        /// General flashes of the whole picture in a second; beyond it the projector rests in the dark for two seconds. WCAG 2.3.1 allows 3; 0 is off.
        flashes_per_second: u32 = 3, "1/s", Within(0, 1_000);
        /// The start of a run acknowledges heat, lamp, emergency stop and flashes that the projector has latched, too; else it refuses
        /// to start and names them. Set it once, on the command line, when the cause is gone.
        acknowledge_faults: bool = false, "", Any;
        /// How much light there may be; docs/SAFETY.md says what that does for people and what it does not.
        limits: LimitsConfig = LimitsConfig::default(), "", Any;
        /// Who else must agree that there is light.
        interlock: InterlockConfig = InterlockConfig::default(), "", Any;
    }
}
