//! What Pupil says: the answers of Pupil Remote, and its messages about gaze and pupils.

use super::eyes::EyeMotion;
use crate::faults::{FaultKind, FaultPlan};
use dpm_device::rng::Draws;
use dpm_device::time::FrameRate;
use dpm_pupil::msgpack::{put_f64, put_map, put_small, put_text, put_vector};

/// Faults that this mock has.
pub const FAULTS: [FaultKind; 5] =
    [FaultKind::Loss, FaultKind::Dropout, FaultKind::Corrupt, FaultKind::Unplug, FaultKind::Reset];

/// How far Pupil has been calibrated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Mapping {
    /// In space.
    #[default]
    Solid,
    /// Onto the picture of the scene camera only.
    Flat,
    /// Not at all: there are pupils and no gaze.
    Missing,
}

/// The mock.
#[derive(Clone, Debug)]
pub struct PupilConfig {
    /// What the eyes do.
    pub eyes: EyeMotion,
    /// Samples per second.
    pub rate: FrameRate,
    /// From the picture of the eyes to the message, nanoseconds.
    pub latency_ns: i64,
    /// Standard deviation of a line of sight about each axis, radians.
    pub noise_rad: f64,
    /// Confidence while the lids are open, 0 to 1; in a blink it is a tenth of that.
    pub confidence: f64,
    /// What Pupil's clock shows at instant 0 of the host's, seconds.
    pub clock_offset_s: f64,
    /// How much faster than the host's it runs, parts per million.
    pub clock_ppm: f64,
    /// How far Pupil has been calibrated.
    pub mapping: Mapping,
    /// What goes wrong.
    pub faults: FaultPlan,
}

impl Default for PupilConfig {
    fn default() -> Self {
        Self {
            eyes: EyeMotion::default(),
            rate: FrameRate::new(200, 1).unwrap_or_else(|| unreachable!("above 0")),
            latency_ns: 8_000_000,
            noise_rad: 0.0,
            confidence: 0.95,
            clock_offset_s: 5_000.0,
            clock_ppm: 0.0,
            mapping: Mapping::Solid,
            faults: FaultPlan::default(),
        }
    }
}

/// A message: its topic and its payload.
pub type Message = (String, Vec<u8>);

impl PupilConfig {
    /// Pupil's clock at an instant of the host's, seconds.
    pub fn clock_s(&self, t_ns: i64) -> f64 {
        self.clock_offset_s + t_ns as f64 * 1e-9 * (1.0 + 1e-6 * self.clock_ppm)
    }

    /// When sample `k` is seen, nanoseconds.
    pub fn seen_ns(&self, k: u64) -> i64 {
        (u128::from(k) * 1_000_000_000 * u128::from(self.rate.den()) / u128::from(self.rate.num())) as i64
    }

    /// What Pupil Remote answers at `t_ns`. `port` is that of the data. `shift_s`: by how much its clock was set, which `T`
    /// changes.
    pub fn answer(&self, words: &str, t_ns: i64, port: u16, shift_s: &mut f64) -> String {
        match words {
            "SUB_PORT" | "PUB_PORT" => port.to_string(),
            "t" => format!("{:?}", self.clock_s(t_ns) + *shift_s),
            "v" => "3.5".into(),
            "R" | "r" | "C" | "c" => "OK".into(),
            _ => match words.strip_prefix("T ").and_then(|to| to.parse::<f64>().ok()) {
                Some(to) => {
                    *shift_s = to - self.clock_s(t_ns);
                    "Timesync successful.".into()
                }
                None => "Unknown command.".into(),
            },
        }
    }

    /// The messages of sample `k`, none if it is lost. `shift_s` as for [`PupilConfig::answer`].
    pub fn messages(&self, k: u64, shift_s: f64) -> Vec<Message> {
        let t_ns = self.seen_ns(k);
        let draws = Draws::new(self.eyes.seed).stream(9);
        let strikes = |kind| self.faults.strikes(kind, draws, k, t_ns - 1, t_ns);
        if strikes(FaultKind::Loss) || self.faults.is_on(FaultKind::Dropout, t_ns) {
            return Vec::new();
        }
        let at_s = self.clock_s(t_ns) + shift_s;
        let mut all: Vec<Message> =
            [0, 1].map(|eye| (format!("pupil.{eye}.3d"), self.pupil(eye, t_ns, at_s))).into();
        match self.mapping {
            Mapping::Solid => all.push(("gaze.3d.01.".into(), self.gaze(k, t_ns, at_s))),
            Mapping::Flat => all.push(("gaze.2d.01.".into(), self.flat(t_ns, at_s))),
            Mapping::Missing => {}
        }
        if strikes(FaultKind::Corrupt) {
            for (_, payload) in &mut all {
                let at = draws.stream(8).bits(k) as usize % payload.len();
                payload[at] ^= 0x55;
            }
        }
        all
    }

    fn confidence_at(&self, t_ns: i64) -> f64 {
        self.confidence * if self.eyes.at(t_ns).is_shut { 0.1 } else { 1.0 }
    }

    /// The keys that all messages have, as pairs of a map.
    fn put_common(&self, topic: &str, t_ns: i64, at_s: f64, out: &mut Vec<u8>) {
        put_text("topic", out);
        put_text(topic, out);
        put_text("timestamp", out);
        put_f64(at_s, out);
        put_text("confidence", out);
        put_f64(self.confidence_at(t_ns), out);
        put_text("norm_pos", out);
        // A scene camera of 1280 x 720 with 90 degrees from side to side; y points up.
        let [x, y, z] = self.eyes.at(t_ns).target_m;
        put_vector(&[0.5 + 0.5 * x / z, 0.5 - 0.5 * y / z * 1280.0 / 720.0], out);
    }

    fn pupil(&self, eye: u8, t_ns: i64, at_s: f64) -> Vec<u8> {
        let mut out = Vec::new();
        put_map(6, &mut out);
        self.put_common(&format!("pupil.{eye}.3d"), t_ns, at_s, &mut out);
        put_text("id", &mut out);
        put_small(eye, &mut out);
        put_text("method", &mut out);
        put_text("pye3d 0.3.0 real-time", &mut out);
        out
    }

    fn flat(&self, t_ns: i64, at_s: f64) -> Vec<u8> {
        let mut out = Vec::new();
        put_map(4, &mut out);
        self.put_common("gaze.2d.01.", t_ns, at_s, &mut out);
        out
    }

    fn gaze(&self, k: u64, t_ns: i64, at_s: f64) -> Vec<u8> {
        let state = self.eyes.at(t_ns);
        // Behind closed lids the detector sees lashes: what it says then is far off, and unsure.
        let spread = self.noise_rad + if state.is_shut { 0.3 } else { 0.0 };
        let noise = Draws::new(self.eyes.seed).stream(7).normal3(k);
        let far = length(&state.target_m);
        let target = [0, 1, 2].map(|i| state.target_m[i] + far * spread * if i < 2 { noise[i] } else { 0.0 });
        let mm = |v: &[f64; 3]| v.map(|x| 1e3 * x);
        let mut out = Vec::new();
        put_map(8, &mut out);
        self.put_common("gaze.3d.01.", t_ns, at_s, &mut out);
        put_text("gaze_point_3d", &mut out);
        put_vector(&mm(&target), &mut out);
        for (key, is_normal) in [("eye_centers_3d", false), ("gaze_normals_3d", true)] {
            put_text(key, &mut out);
            put_map(2, &mut out);
            for (eye, centre) in EyeMotion::EYES_M.iter().enumerate() {
                put_small(eye as u8, &mut out);
                let line = [0, 1, 2].map(|i| target[i] - centre[i]);
                let normal = line.map(|x| x / length(&line));
                put_vector(&if is_normal { normal } else { mm(centre) }, &mut out);
            }
        }
        put_text("base_data", &mut out);
        // An array of both pupils.
        out.push(0x92);
        [0, 1].iter().for_each(|eye| out.extend(self.pupil(*eye, t_ns, at_s)));
        out
    }
}

fn length(v: &[f64; 3]) -> f64 {
    libm::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
}
