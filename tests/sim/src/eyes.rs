//! The law of the eye guard: no light goes where a head is.
//!
//! It asks nothing of the program. The head moves as [`head_motion`] says, the mirrors that are lit are those of the
//! projector, and the rays are those of its lens. What the tracker reports of the head is nobody's business here.

use dpm_rig::rig::Rig;
use glam::{DVec2, DVec3, Vec3};
use hil_mock::motion::{Motion, MotionSpec};

use dpm_device::pose::Pose;

/// How the tracker names the glasses.
pub const GLASSES: &str = "glasses";
/// Their number.
pub const GLASSES_NUMBER: i32 = 2;
/// Radius of the sphere that stays dark, metres.
pub const RADIUS_M: f64 = 0.1;
/// A crew has seen the head where it is after this time, nanoseconds: three samples, and the frames that were planned before.
const SEEN_NS: i64 = 200_000_000;
/// A tracker that has named a head for so long where it cannot be is believed, nanoseconds: docs/SAFETY.md.
const BELIEVED_NS: i64 = 10_000_000_000;
/// The tracker's noise is beyond three standard deviations now and then, metres.
const NOISE_M: f64 = 0.001;

/// The head of a person who stands in the beam, `scale` times as large: it goes to and fro at 0.6 m/s, with turns of 15 m/s2.
///
/// # Errors
/// The motion is none, which is a mistake in this program.
pub fn head_motion(scale: f64) -> Result<Motion, String> {
    let spec = MotionSpec::Translate {
        direction: [0.3, 1.0, 0.2],
        speed_m_s: 0.6 * scale,
        amplitude_m: 0.1 * scale,
        acceleration_m_s2: 15.0 * scale,
        rest_s: 0.3,
    };
    let rest = Pose { position_m: [0.15 * scale, 0.2 * scale, 0.3 * scale], ..Pose::IDENTITY };
    Motion::new(&spec, rest).map_err(|e| e.to_string())
}

/// See the module's documentation.
pub struct EyeLaw {
    head: Motion,
    position: DVec3,
    /// The rays of all mirrors, row after row, of unit length.
    rays: Vec<Vec3>,
    plane_bytes: usize,
    row_bytes: usize,
    width: usize,
    /// All planes of a slot together.
    lit: Vec<u8>,
    /// From when to when the head's label was at another body, lately.
    exchanges: Vec<[i64; 2]>,
    /// Slots in which mirrors were lit, and mirrors lit in all of them.
    pub slots: u64,
    /// See `slots`.
    pub mirrors: u64,
}

impl EyeLaw {
    /// That of `rig`.
    ///
    /// # Errors
    /// As [`head_motion`].
    pub fn new(rig: &Rig) -> Result<Self, String> {
        let camera = &rig.camera;
        let raster = camera.raster;
        let (width, height) = (raster.width(), raster.height());
        let centre = |i: u32| DVec2::new(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
        Ok(Self {
            head: head_motion(1.0)?,
            position: camera.position(),
            rays: (0..width * height).map(|i| camera.ray(centre(i)).direction.as_vec3()).collect(),
            plane_bytes: raster.plane_bytes(),
            row_bytes: raster.row_bytes(),
            width: width as usize,
            lit: vec![0; raster.plane_bytes()],
            exchanges: Vec::new(),
            slots: 0,
            mirrors: 0,
        })
    }

    /// The head's label is at another body from `from` until `until`.
    pub fn exchanged(&mut self, from: i64, until: i64) {
        self.exchanges.retain(|[_, until]| from < until + 2 * BELIEVED_NS);
        self.exchanges.push([from, until]);
    }

    /// Until when a crew that was ready at `crew_ready` cannot know where the head is: it has never seen it but under exchanged
    /// labels, and when they are right again, it has these to doubt.
    pub fn blind_until(&self, crew_ready: i64) -> i64 {
        let blind = self
            .exchanges
            .iter()
            .filter(|[from, until]| crew_ready + SEEN_NS >= *from && crew_ready <= *until);
        blind.map(|[_, until]| until + BELIEVED_NS + SEEN_NS).max().unwrap_or(i64::MIN)
    }

    /// Light of `planes` from `first` to `last` of the world's time.
    ///
    /// # Errors
    /// A mirror is lit whose ray meets the head.
    pub fn see(&mut self, planes: &[u8], first: i64, last: i64) -> Result<(), String> {
        self.lit.fill(0);
        for plane in planes.chunks_exact(self.plane_bytes) {
            self.lit.iter_mut().zip(plane).for_each(|(lit, byte)| *lit |= byte);
        }
        let lit = self.lit.iter().map(|byte| u64::from(byte.count_ones())).sum::<u64>();
        self.slots += u64::from(lit > 0);
        self.mirrors += lit;
        [first, (first + last) / 2, last].into_iter().try_for_each(|at| self.spares(at))
    }

    /// Nothing that is lit meets the head at `at`.
    fn spares(&self, at: i64) -> Result<(), String> {
        let head = DVec3::from_array(self.head.pose_at(at).position_m);
        let to = head - self.position;
        let sine = (RADIUS_M - NOISE_M) / to.length();
        let (axis, cosine) = (to.normalize().as_vec3(), (1.0 - sine * sine).sqrt() as f32);
        for (row, (bytes, rays)) in
            self.lit.chunks_exact(self.row_bytes).zip(self.rays.chunks_exact(self.width)).enumerate()
        {
            for (column, ray) in rays.iter().enumerate() {
                let is_lit = bytes[column / 8] << (column % 8) & 0x80 != 0;
                if is_lit && ray.dot(axis) > cosine {
                    let off_m = to.length() * f64::from(ray.dot(axis)).clamp(-1.0, 1.0).acos();
                    return Err(format!(
                        "mirror {column}, {row} lights a head that is {:.1} cm from its ray; {:.1} cm are to be dark",
                        off_m * 100.0,
                        RADIUS_M * 100.0
                    ));
                }
            }
        }
        Ok(())
    }
}
