//! All fake cameras of this process.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, Once, OnceLock, PoisonError};
use std::time::Duration;

use crate::{hooks, Settings};

pub(crate) fn lock<T>(m: &Mutex<T>) -> MutexGuard<'_, T> {
    m.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What a camera counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Witness {
    /// How often it was opened.
    pub opened: u32,
    /// Files that are open now.
    pub open: u32,
    /// Streams that were begun.
    pub streams: u32,
    /// Requests that were refused by a rule, and not by the settings.
    pub refusals: u32,
    /// Pictures that were handed out.
    pub pictures: u32,
    /// Pictures for which the driver had no buffer.
    pub without_buffer: u32,
    /// Value of the control for the exposure, 100 us.
    pub exposure: i32,
    /// Value of the control for the gain.
    pub gain: i32,
    /// The camera exposes by itself.
    pub is_automatic: bool,
}

/// A camera at its path.
pub(crate) struct Camera {
    pub settings: Mutex<Settings>,
    pub is_gone: AtomicBool,
    pub witness: Mutex<Witness>,
    /// The file that streams, by its number.
    pub streaming: Mutex<Option<i32>>,
}

impl Camera {
    fn new(settings: Settings) -> Self {
        let witness = Witness {
            is_automatic: settings.is_automatic,
            exposure: settings.exposure.as_ref().map_or(0, |r| 157.clamp(*r.start(), *r.end())),
            gain: settings.gain.as_ref().map_or(0, |r| *r.start()),
            ..Witness::default()
        };
        Self {
            settings: Mutex::new(settings),
            is_gone: AtomicBool::new(false),
            witness: Mutex::new(witness),
            streaming: Mutex::new(None),
        }
    }

    pub(crate) fn settings(&self) -> Settings {
        lock(&self.settings).clone()
    }

    pub(crate) fn is_gone(&self) -> bool {
        self.is_gone.load(Ordering::Acquire)
    }
}

static CAMERAS: Mutex<Vec<Arc<Camera>>> = Mutex::new(Vec::new());
/// False while no camera was ever plugged in: then no path is looked at.
static ANY: AtomicBool = AtomicBool::new(false);

/// The camera at `path`, be it gone.
pub(crate) fn at(path: &[u8]) -> Option<Arc<Camera>> {
    read_file();
    if !ANY.load(Ordering::Acquire) {
        return None;
    }
    let is_it = |c: &&Arc<Camera>| lock(&c.settings).path.as_os_str().as_encoded_bytes() == path;
    lock(&CAMERAS).iter().rev().find(is_it).cloned()
}

fn add(settings: Settings) -> Arc<Camera> {
    hooks::keep_linked();
    let camera = Arc::new(Camera::new(settings));
    lock(&CAMERAS).push(camera.clone());
    ANY.store(true, Ordering::Release);
    camera
}

/// A camera that a test has plugged in. Dropping it unplugs it.
pub struct FakeCamera {
    camera: Arc<Camera>,
}

impl FakeCamera {
    /// A camera of these words ([`Settings::parse`]).
    ///
    /// # Panics
    /// A word is not understood.
    pub fn plug_in(words: &str) -> Self {
        Self { camera: add(Settings::parse(words).unwrap_or_else(|e| panic!("{e}"))) }
    }

    /// Pulls the plug.
    pub fn unplug(&self) {
        self.camera.is_gone.store(true, Ordering::Release);
    }

    /// Plugs it in again, as other words say, under its path.
    ///
    /// # Panics
    /// A word is not understood.
    pub fn return_as(&self, words: &str) {
        let settings = Settings::parse(words).unwrap_or_else(|e| panic!("{e}"));
        *lock(&self.camera.settings) = settings;
        self.camera.is_gone.store(false, Ordering::Release);
    }

    /// What it has counted.
    pub fn witness(&self) -> Witness {
        *lock(&self.camera.witness)
    }
}

impl Drop for FakeCamera {
    fn drop(&mut self) {
        self.unplug();
        lock(&CAMERAS).retain(|c| !Arc::ptr_eq(c, &self.camera));
    }
}

/// The file of cameras, if the environment names one.
fn file() -> Option<&'static Path> {
    static FILE: OnceLock<Option<PathBuf>> = OnceLock::new();
    FILE.get_or_init(|| std::env::var_os("FAKE_V4L2").map(PathBuf::from)).as_deref()
}

/// Reads the file of cameras for the first time, and begins to watch it.
fn read_file() {
    static ONCE: Once = Once::new();
    let Some(path) = file() else { return };
    // The file is opened through our own names, which come here again.
    if ONCE.is_completed() {
        return;
    }
    std::thread_local!(static INSIDE: std::cell::Cell<bool> = const { std::cell::Cell::new(false) });
    if INSIDE.replace(true) {
        return;
    }
    ONCE.call_once(|| {
        update(path);
        let watch = move || loop {
            std::thread::sleep(Duration::from_millis(20));
            update(path);
        };
        drop(std::thread::Builder::new().name("fake-v4l2-file".into()).spawn(watch));
    });
    INSIDE.set(false);
}

/// Plugs in and pulls what the lines of the file say.
fn update(path: &Path) {
    let text = crate::hooks::raw::read(path);
    let parsed = text
        .lines()
        .filter(|l| !l.trim().is_empty())
        .filter_map(|line| Settings::parse(line).map_err(|e| eprintln!("{e}")).ok());
    let wanted: Vec<Settings> = parsed.collect();
    let all: Vec<Arc<Camera>> = lock(&CAMERAS).clone();
    for camera in &all {
        let own = camera.settings().path;
        camera.is_gone.store(!wanted.iter().any(|w| w.path == own), Ordering::Release);
    }
    for settings in wanted {
        match all.iter().find(|c| lock(&c.settings).path == settings.path) {
            Some(camera) => *lock(&camera.settings) = settings,
            None => drop(add(settings)),
        }
    }
}
