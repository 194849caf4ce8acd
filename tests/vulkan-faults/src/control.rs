//! How tests use the layer: in another process through its environment, in their own through its functions.

use crate::interface::Loaded;
use crate::plan::{Call, Plan, PlanError};
use std::ffi::CString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

/// The layer's name for the loader.
pub const LAYER_NAME: &str = "VK_LAYER_DPM_faults";

/// Where explicit layers of the system are: `VK_LAYER_PATH` replaces the loader's own list, and the validation layer must still be found.
/// (`VK_ADD_LAYER_PATH` would do without, but loaders before 1.3.207 do not know it.)
const SYSTEM_LAYERS: [&str; 3] = [
    "/usr/share/vulkan/explicit_layer.d",
    "/etc/vulkan/explicit_layer.d",
    "/usr/local/share/vulkan/explicit_layer.d",
];

/// The layer for programs in processes of their own: a folder with its manifest, its plan and its log.
pub struct FaultLayer {
    folder: PathBuf,
}

/// Something that the layer did or saw.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// The kind of the fault, or `noticed`.
    pub what: String,
    /// The call, by its word in plans; `submit-after-loss` for submissions to a device that was lost.
    pub call: String,
    /// Its number since the plan was given.
    pub number: u64,
}

impl FaultLayer {
    /// Writes the manifest into a new temporary folder, which goes with the value. `name` tells folders apart.
    ///
    /// # Errors
    /// The folder cannot be written, or the library was not built with the tests.
    pub fn new(name: &str) -> std::io::Result<Self> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let folder = format!("vulkan-faults-{}-{number}-{name}", std::process::id());
        let layer = Self { folder: std::env::temp_dir().join(folder) };
        std::fs::create_dir_all(&layer.folder)?;
        write_manifest(&layer.folder)?;
        Ok(layer)
    }

    /// The environment that makes a program's Vulkan fail by `plan`.
    ///
    /// # Panics
    /// When the plan is not understood or the folder has gone: a test's mistake.
    pub fn variables(&self, plan: &str) -> Vec<(String, String)> {
        self.set(plan).unwrap_or_else(|e| panic!("{e}"));
        let mut variables = loader_variables(&self.folder);
        variables.push(("DPM_VK_FAULTS_FILE".into(), text(&self.plan())));
        variables.push(("DPM_VK_FAULTS_LOG".into(), text(&self.log())));
        variables
    }

    /// Gives another plan to the program while it runs. Everything is counted anew from its next call on.
    ///
    /// # Errors
    /// The plan is not understood, or cannot be written.
    pub fn set(&self, plan: &str) -> Result<(), PlanError> {
        plan.parse::<Plan>()?;
        // In one step: the layer never reads half a plan.
        let new = self.folder.join("plan.new");
        (std::fs::write(&new, plan).and_then(|()| std::fs::rename(&new, self.plan())))
            .unwrap_or_else(|e| panic!("{}: {e}", new.display()));
        Ok(())
    }

    /// What happened so far, oldest first.
    pub fn events(&self) -> Vec<Event> {
        let log = std::fs::read_to_string(self.log()).unwrap_or_default();
        let event = |line: &str| {
            let mut words = line.split(' ');
            Some(Event {
                at_ns: words.next()?.parse().ok()?,
                what: words.next()?.to_owned(),
                call: words.next()?.to_owned(),
                number: words.next()?.parse().ok()?,
            })
        };
        log.lines().filter_map(event).collect()
    }

    fn plan(&self) -> PathBuf {
        self.folder.join("plan")
    }

    fn log(&self) -> PathBuf {
        self.folder.join("log")
    }
}

impl Drop for FaultLayer {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

/// The layer's library, which cargo builds beside the tests of every crate that depends on this one.
fn library() -> std::io::Result<PathBuf> {
    let program = std::env::current_exe()?;
    let name = "libvulkan_faults.so";
    (program
        .ancestors()
        .skip(1)
        .take(3)
        .flat_map(|folder| [folder.join(name), folder.join("deps").join(name)]))
    .find(|path| path.exists())
    .ok_or_else(|| std::io::Error::other(format!("{name} is not beside {}", program.display())))
}

fn write_manifest(folder: &Path) -> std::io::Result<()> {
    let library = text(&library()?);
    let manifest = format!(
        r#"{{
  "file_format_version": "1.1.2",
  "layer": {{
    "name": "{LAYER_NAME}",
    "type": "GLOBAL",
    "library_path": {library:?},
    "api_version": "1.3.0",
    "implementation_version": "1",
    "description": "Faults on request, for tests"
  }}
}}
"#
    );
    std::fs::write(folder.join("VkLayer_dpm_faults.json"), manifest)
}

/// What makes the loader find and use the layer, beside what is asked of it already.
fn loader_variables(folder: &Path) -> Vec<(String, String)> {
    let was = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
    let mut folders = vec![text(folder)];
    match was("VK_LAYER_PATH") {
        Some(path) => folders.push(path),
        None => folders.extend(SYSTEM_LAYERS.map(str::to_owned)),
    }
    let mut layers = vec![LAYER_NAME.to_owned()];
    layers.extend(was("VK_INSTANCE_LAYERS").filter(|l| !l.contains(LAYER_NAME)));
    vec![("VK_LAYER_PATH".into(), folders.join(":")), ("VK_INSTANCE_LAYERS".into(), layers.join(":"))]
}

/// The layer in this process.
pub struct Layer {
    loaded: Loaded,
    turn: Mutex<()>,
}

/// The layer in this process. The first call sets the loader's variables: it must come before anything of Vulkan.
///
/// # Panics
/// When the library was not built with the tests, or the temporary folder cannot be written.
pub fn in_this_process() -> &'static Layer {
    static LAYER: OnceLock<Layer> = OnceLock::new();
    LAYER.get_or_init(|| {
        let folder = std::env::temp_dir().join(format!("vulkan-faults-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("the temporary folder can be written");
        write_manifest(&folder).unwrap_or_else(|e| panic!("{e}"));
        for (name, value) in loader_variables(&folder) {
            std::env::set_var(name, value);
        }
        let path = CString::new(text(&library().unwrap_or_else(|e| panic!("{e}")))).expect("a path");
        let loaded = Loaded::open(&path).expect("the layer's library can be opened");
        Layer { loaded, turn: Mutex::new(()) }
    })
}

impl Layer {
    /// Puts `plan` in force until the session is dropped. Tests take turns.
    ///
    /// # Panics
    /// When the plan is not understood.
    pub fn plan(&'static self, plan: &str) -> Session {
        let turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let session = Session { layer: self, _turn: turn };
        session.set(plan);
        session
    }
}

/// One test's time with the layer of this process.
pub struct Session {
    layer: &'static Layer,
    _turn: MutexGuard<'static, ()>,
}

impl Session {
    /// Another plan; everything is counted anew.
    ///
    /// # Panics
    /// When the plan is not understood.
    pub fn set(&self, plan: &str) {
        let text = CString::new(plan).expect("no zero in a plan");
        assert!(self.layer.loaded.set(&text), "{plan:?} is no plan: {:?}", plan.parse::<Plan>().err());
    }

    /// Calls since the plan was given.
    pub fn count(&self, call: Call) -> u64 {
        self.layer.loaded.count(&CString::new(call.word()).expect("a word"))
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.layer.loaded.set(c"");
    }
}
