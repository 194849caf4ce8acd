//! Loads a [`Scene`] from a glTF, OBJ, PLY or STL file, such that nothing in the file can crash or block the caller.

use crossbeam::channel::{bounded, RecvTimeoutError};
use glam::DMat3;
use std::path::Path;

use super::limits::{Cancel, Limits};
use super::mesh_file::MeshFormat;
use super::{gltf_file, mesh_file, Scene, SceneError, Texture};

/// The node of the file for a rigid body of the rig file. The node and its descendants move as one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BodySelector {
    /// Name of the rigid body.
    pub name: String,
    /// Name of the glTF node; must occur once. `None`: the node with the body's own name. If no body states its node
    /// and the file has none of their names, the bodies are the first objects of the scene in order, and a warning
    /// lists the assignment.
    pub node: Option<String>,
    /// False: nothing is projected on it; it is only seen in reflections and casts virtual shadows.
    pub projected: bool,
}

/// An axis of a file that points up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UpAxis {
    /// +X.
    X,
    /// +Y, as in glTF and in the world of a rig.
    #[default]
    Y,
    /// +Z, as in most CAD programs.
    Z,
}

impl UpAxis {
    /// Its letter.
    pub fn word(self) -> &'static str {
        match self {
            Self::X => "x",
            Self::Y => "y",
            Self::Z => "z",
        }
    }

    /// The rotation of a file's axes into those of the world, in which +Y is up.
    pub(crate) fn to_world(self) -> DMat3 {
        match self {
            Self::X => DMat3::from_rotation_z(std::f64::consts::FRAC_PI_2),
            Self::Y => DMat3::IDENTITY,
            Self::Z => DMat3::from_rotation_x(-std::f64::consts::FRAC_PI_2),
        }
    }
}

/// How to read a scene file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadOptions {
    /// Rigid bodies: the i-th becomes the body with `tracked == Some(i)`. Empty: the first two objects of the scene.
    pub bodies: Vec<BodySelector>,
    /// Names of nodes (with their descendants) that exist only in the virtual world: lamps, surroundings.
    pub virtual_nodes: Vec<String>,
    /// Metres in a unit of the file, above 0. `None`: 1 for glTF, a guess that a warning tells for other formats.
    pub scale: Option<f64>,
    /// The axis of the file that points up. `None`: Y for glTF, a guess that a warning tells for other formats.
    pub up: Option<UpAxis>,
    /// Which animation of the file plays.
    pub animation: AnimationChoice,
    /// How fast it plays, above 0. `None`: as the file says, 1.
    pub animation_speed: Option<f64>,
    /// Limits on size and time.
    pub limits: Limits,
}

/// Which animation of a file plays.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum AnimationChoice {
    /// The first one, if there is any.
    #[default]
    First,
    /// The one of this name.
    Named(String),
    /// None: everything is shown at rest.
    Off,
}

/// Reads a `.glb`, `.gltf`, `.obj`, `.ply` or `.stl` file. The bodies of formats without nodes are their objects; a file
/// without named objects has one, with the file's name.
///
/// # Errors
/// Whatever the file contains, the result is a scene or a [`SceneError::InFile`] that names the place and the problem,
/// within [`Limits::time`]: a separate thread does the work. It is told to stop when time is up, and its panics are
/// caught.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Scene, SceneError> {
    let (owned_path, owned_options) = (path.to_path_buf(), options.clone());
    let work = move |cancel: &Cancel| {
        let bytes = gltf_file::read_file(&owned_path, owned_options.limits.bytes)?;
        read(&bytes, Some(&owned_path), &owned_options, cancel)
    };
    contained(&options.limits, work).map_err(|e| e.in_file(path))
}

/// Reads a scene from memory; it cannot refer to files.
///
/// # Errors
/// As [`load`], without the path.
pub fn load_bytes(bytes: &[u8], options: &LoadOptions) -> Result<Scene, SceneError> {
    let (bytes, owned_options) = (bytes.to_vec(), options.clone());
    contained(&options.limits, move |cancel| read(&bytes, None, &owned_options, cancel))
}

/// [`load_bytes`] in this thread, where a panic is a panic and nothing stops it when time is up: for fuzzers.
#[doc(hidden)]
pub fn load_bytes_here(bytes: &[u8], options: &LoadOptions) -> Result<Scene, SceneError> {
    read(bytes, None, options, &Cancel::default())
}

/// A mesh file of `format` in this thread, as [`load_bytes_here`]: an OBJ file cannot be told by its bytes.
///
/// # Errors
/// As [`load`], without the path.
#[doc(hidden)]
pub fn load_mesh_here(bytes: &[u8], format: MeshFormat, options: &LoadOptions) -> Result<Scene, SceneError> {
    mesh_file::read(bytes, format, None, options, &Cancel::default())
}

/// The texture of an image of any format in this thread, as [`load_bytes_here`].
///
/// # Errors
/// It cannot be decoded, or has more than a million texels.
#[doc(hidden)]
pub fn decode_picture_here(bytes: &[u8]) -> Result<Texture, SceneError> {
    gltf_file::decode_picture(bytes, 0, &Limits { texels: 1 << 20, ..Limits::default() })
}

fn read(
    bytes: &[u8],
    beside: Option<&Path>,
    options: &LoadOptions,
    cancel: &Cancel,
) -> Result<Scene, SceneError> {
    match MeshFormat::of(beside, bytes) {
        Some(format) => mesh_file::read(bytes, format, beside, options, cancel),
        None => gltf_file::read(bytes, beside, options, cancel),
    }
}

/// Runs `work` in a helper thread for at most `limits.time`.
pub(super) fn contained<T: Send + 'static>(
    limits: &Limits,
    work: impl FnOnce(&Cancel) -> Result<T, SceneError> + Send + 'static,
) -> Result<T, SceneError> {
    let cancel = Cancel::default();
    let (inside, (send, receive)) = (cancel.clone(), bounded(1));
    let helper = std::thread::Builder::new().name("scene-load".into()).spawn(move || {
        // A panic here means a broken scene, not a broken run.
        dpm_common::stopping::expect_panics();
        let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| work(&inside))).unwrap_or_else(
            |panic| {
                let text = panic
                    .downcast_ref::<String>()
                    .cloned()
                    .or_else(|| panic.downcast_ref::<&str>().map(|s| (*s).to_owned()));
                Err(SceneError::Internal(text.unwrap_or_else(|| "no message".into())))
            },
        );
        let _ = send.send(result); // nobody waits any more if the time was up
    });
    helper.map_err(SceneError::Read)?;
    match receive.recv_timeout(limits.time) {
        Ok(result) => result,
        Err(RecvTimeoutError::Timeout) => {
            cancel.cancel();
            Err(SceneError::TimedOut(limits.time))
        }
        Err(RecvTimeoutError::Disconnected) => {
            Err(SceneError::Internal("the loading thread vanished".into()))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn a_panic_inside_becomes_an_error() {
        let result: Result<(), _> = contained(&Limits::default(), |_| panic!("index 7"));
        assert!(result.unwrap_err().to_string().contains("index 7"));
    }

    #[test]
    fn time_is_bounded_and_the_helper_is_told_to_stop() {
        let limits = Limits { time: Duration::from_millis(20), ..Limits::default() };
        let (told, ended) = bounded(1);
        let inner = limits.clone();
        let start = Instant::now();
        let result: Result<(), _> = contained(&limits, move |cancel| loop {
            if let Err(e) = cancel.check(&inner) {
                told.send(()).ok();
                return Err(e);
            }
            std::thread::sleep(Duration::from_millis(1));
        });
        assert!(matches!(result, Err(SceneError::TimedOut(_))));
        assert!(start.elapsed() < Duration::from_secs(5));
        assert!(ended.recv_timeout(Duration::from_secs(5)).is_ok());
    }
}
