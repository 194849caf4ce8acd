//! The pictures of the live page: what falls on the bodies, and what the observer sees.
//!
//! A thread of its own makes them, only while somebody looks, at most ten times a second, and never with more than a
//! small share of a core: after a picture that took long it rests for long. It uses no GPU, because that one belongs
//! to the frames.

mod depth;
mod eye;
pub(crate) mod mesh;

use dpm_common::realtime::os::{give_way, thread_cpu_ns};
use dpm_rig::pictures::to_srgb;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::live::{Live, SeenLight};
use dpm_rig::telemetry::monitor::{ProjectorHealth, RunMonitor};
use eye::{Eye, Linear};
use glam::Vec3;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// The shortest time between two pictures.
const EVERY: Duration = Duration::from_millis(100);
/// The longest time between two pictures while somebody looks.
const AT_LEAST_EVERY: Duration = Duration::from_secs(20);
/// Share of a core that the pictures may take. The rest of the page's twentieth goes to those who look.
const SHARE: f64 = 0.035;
/// How long a look lasts; a viewer looks again before that.
const LOOK: Duration = Duration::from_secs(1);
/// How long the mock projector may take to show its light.
const LIGHT_WITHIN: Duration = Duration::from_millis(200);

/// The newest pictures.
#[derive(Clone, Debug, Default)]
pub(crate) struct Newest {
    /// Number of the pictures; 0 before the first ones.
    pub number: u64,
    /// PNG of the light that falls through the projector's raster.
    pub light: Option<Vec<u8>>,
    /// PNG of what the observer sees.
    pub viewer: Option<Vec<u8>>,
    /// Why a picture is missing, or what is to be known of it.
    pub told: Option<String>,
    /// Pictures in a second.
    pub per_s: f64,
}

#[derive(Debug)]
struct PictureRequests {
    looked_until: Option<Instant>,
    stop: bool,
    newest: Arc<Newest>,
}

#[derive(Debug)]
struct PictureQueue {
    monitor: Arc<RunMonitor>,
    state: Mutex<PictureRequests>,
    changed: Condvar,
}

/// The thread that makes pictures; it ends when this is dropped.
#[derive(Debug)]
pub(crate) struct PictureThread {
    inner: Arc<PictureQueue>,
    thread: Option<JoinHandle<()>>,
}

impl PictureThread {
    /// Starts the thread, which sleeps until somebody looks.
    pub(crate) fn start(monitor: Arc<RunMonitor>) -> std::io::Result<Self> {
        let state = PictureRequests { looked_until: None, stop: false, newest: Arc::default() };
        let inner = Arc::new(PictureQueue { monitor, state: Mutex::new(state), changed: Condvar::new() });
        let thread = std::thread::Builder::new().name("dpm-pictures".into()).spawn({
            let inner = inner.clone();
            move || {
                give_way(19);
                inner.run();
            }
        })?;
        Ok(Self { inner, thread: Some(thread) })
    }

    /// Somebody looks, for the next second.
    pub(crate) fn look(&self) {
        let mut state = self.inner.state();
        let slept = state.looked_until.is_none();
        state.looked_until = Some(Instant::now() + LOOK);
        if slept {
            self.inner.changed.notify_all();
        }
    }

    /// The newest pictures.
    pub(crate) fn newest(&self) -> Arc<Newest> {
        self.inner.state().newest.clone()
    }
}

impl Drop for PictureThread {
    fn drop(&mut self) {
        self.inner.state().stop = true;
        self.inner.changed.notify_all();
        // A picture takes milliseconds.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl PictureQueue {
    fn state(&self) -> MutexGuard<'_, PictureRequests> {
        // Nothing panics while it holds this lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn run(&self) {
        let mut maker = None;
        let mut begin = Instant::now();
        let mut cpu_ns = thread_cpu_ns();
        let mut every = EVERY;
        while self.is_looked_at() {
            if let Some(rig) = self.monitor.live().rig() {
                let maker = maker.get_or_insert_with(|| Maker::new(rig));
                let mut newest = maker.make(&self.monitor);
                newest.per_s = 1.0 / every.as_secs_f64();
                let mut state = self.state();
                newest.number = state.newest.number + 1;
                state.newest = Arc::new(newest);
            }
            // What this round took decides when the next one begins.
            let took_ns = (thread_cpu_ns() - cpu_ns).max(0) as f64;
            every = Duration::from_secs_f64(took_ns * 1e-9 / SHARE).clamp(EVERY, AT_LEAST_EVERY);
            self.rest_until(begin + every);
            (begin, cpu_ns) = (Instant::now(), thread_cpu_ns());
        }
    }

    /// Waits until somebody looks; false if the thread is to end.
    fn is_looked_at(&self) -> bool {
        let mut state = self.state();
        loop {
            if state.stop {
                return false;
            }
            match state.looked_until {
                Some(until) if Instant::now() < until => return true,
                _ => state.looked_until = None,
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn rest_until(&self, at: Instant) {
        let mut state = self.state();
        while !state.stop {
            let left = at.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// Makes the pictures of one rig.
struct Maker {
    eye: Eye,
    has_light: bool,
    light: SeenLight,
    /// The brightest radiance of the last pictures, scene units.
    white: f32,
    srgb: Vec<u8>,
}

impl Maker {
    fn new(rig: &Arc<Rig>) -> Self {
        let table: Vec<Vec3> = (0..=TABLE).map(|k| Vec3::splat(k as f32 / TABLE as f32)).collect();
        Self {
            eye: Eye::new(rig),
            has_light: rig.config.projector.backend.is_mock(),
            light: SeenLight::default(),
            white: 0.0,
            srgb: to_srgb(&table, 1.0).chunks_exact(3).map(|c| c[0]).collect(),
        }
    }

    fn make(&mut self, monitor: &RunMonitor) -> Newest {
        let live = monitor.live();
        if !self.has_light {
            return Newest {
                told: Some("The light of a real projector cannot be observed from here.".into()),
                ..Newest::default()
            };
        }
        if !self.see_light(live) {
            // The mock's thread is over, or stands still.
            let told = match monitor.projector() {
                ProjectorHealth::Stopped => "The run is over.",
                _ => "The projector shows no light yet.",
            };
            return Newest { told: Some(told.into()), ..Newest::default() };
        }
        let Some(light) = self.eye.light(&self.light) else {
            let told = Some("The planes of the projector are not those of the rig.".into());
            return Newest { told, ..Newest::default() };
        };
        let poses = live.poses_of(&self.light);
        let viewer = poses.and_then(|(poses, t_ns)| self.eye.viewer(&light, &poses, t_ns));
        let told = viewer.is_none().then(|| match self.light.is_moved {
            true => {
                "Tracks moved the light, and where the bodies were then is known with a mock tracker only."
                    .into()
            }
            false => "The poses of the bodies are not known yet.".into(),
        });
        let viewer = viewer.map(|viewer| {
            let white = viewer.pixels.iter().fold(1e-9f32, |m, v| m.max(v.max_element()));
            // The exposure follows slowly, so that a picture that becomes darker is seen to do so.
            self.white = white.max(self.white * 0.98);
            self.png(&viewer, 1.0 / self.white)
        });
        Newest { light: self.png(&light, 1.0), viewer: viewer.flatten(), told, ..Newest::default() }
    }

    /// Gets the newest light; false if there is none.
    fn see_light(&mut self, live: &Live) -> bool {
        live.want_light();
        let begin = Instant::now();
        while begin.elapsed() < LIGHT_WITHIN {
            std::thread::sleep(Duration::from_millis(2));
            if live.take_light(&mut self.light) {
                return true;
            }
        }
        false
    }

    fn png(&self, picture: &Linear, scale: f32) -> Option<Vec<u8>> {
        let code = |v: f32| self.srgb[(v * scale * TABLE as f32).clamp(0.0, TABLE as f32) as usize];
        let bytes: Vec<u8> = picture.pixels.iter().flat_map(|p| [code(p.x), code(p.y), code(p.z)]).collect();
        let mut png = Vec::with_capacity(64 << 10);
        let (width, height) = (picture.raster.width(), picture.raster.height());
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub)
            .write_image(&bytes, width, height, ExtendedColorType::Rgb8)
            .ok()
            .map(|()| png)
    }
}

/// Steps of the table from linear light to sRGB.
const TABLE: usize = 8191;
