//! Loads a [`Scene`] from a glTF file, such that nothing in the file can crash or block the caller.

use crossbeam::channel::{bounded, RecvTimeoutError};
use std::path::Path;

use super::limits::{Cancel, Limits};
use super::{gltf_file, Scene, SceneError};

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

/// How to read a scene file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LoadOptions {
    /// Rigid bodies: the i-th becomes the body with `tracked == Some(i)`. Empty: the first two objects of the scene.
    pub bodies: Vec<BodySelector>,
    /// Names of nodes (with their descendants) that exist only in the virtual world: lamps, surroundings.
    pub virtual_nodes: Vec<String>,
    /// Limits on size and time.
    pub limits: Limits,
}

/// Reads a `.glb` or `.gltf` file.
///
/// # Errors
/// Whatever the file contains, the result is a scene or a [`SceneError::InFile`] that names the place and the problem,
/// within [`Limits::time`]: a separate thread does the work. It is told to stop when time is up, and its panics are
/// caught.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Scene, SceneError> {
    let (owned_path, owned_options) = (path.to_path_buf(), options.clone());
    let work = move |cancel: &Cancel| {
        let bytes = gltf_file::read_file(&owned_path, owned_options.limits.bytes)?;
        gltf_file::read(&bytes, Some(&owned_path), &owned_options, cancel)
    };
    contained(&options.limits, work).map_err(|e| e.in_file(path))
}

/// Reads a scene from memory; it cannot refer to files.
///
/// # Errors
/// As [`load`], without the path.
pub fn load_bytes(bytes: &[u8], options: &LoadOptions) -> Result<Scene, SceneError> {
    let (bytes, owned_options) = (bytes.to_vec(), options.clone());
    contained(&options.limits, move |cancel| gltf_file::read(&bytes, None, &owned_options, cancel))
}

/// [`load_bytes`] in this thread, where a panic is a panic and nothing stops it when time is up: for fuzzers.
#[doc(hidden)]
pub fn load_bytes_here(bytes: &[u8], options: &LoadOptions) -> Result<Scene, SceneError> {
    gltf_file::read(bytes, None, options, &Cancel::default())
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
