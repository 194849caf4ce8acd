//! The guardian's side of [`crate::scan_out::ScanOut::guarded`]: black after the program's death, for as long as nobody else
//! wants the display.
//!
//! Who drives a card of its own lets go of it and keeps the black picture; the next program takes the card over it. A lease
//! cannot be taken over: whoever lent it lends it again when its last descriptor is closed. So a guardian of a lease listens
//! at a socket in the user's runtime folder, and [`let_go`] asks it to end.

use std::os::fd::OwnedFd;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use drm::control::{crtc, framebuffer, Device as _, PageFlipFlags};
use drm::Device as _;

use super::{call, CardDescriptor, BLACK_PATIENCE, STEP};
use crate::scan_out::DisplayError;

/// Names of the sockets begin so; the connector's name follows.
const SOCKET: &str = "dpm-guardian-";
/// How long a guardian may need to end after it was asked.
const GOES_WITHIN: Duration = Duration::from_secs(2);

/// Shows the picture `black` on `crtc` with the descriptor that the guardian was started with, and keeps it there until
/// another program drives the displays, for `hold` at most. The end of the last program that holds a card gives its displays
/// back to the console. A lease ends too when it is taken back, or when [`let_go`] asks for it.
///
/// # Errors
/// The kernel does not take the picture: of a lease that was taken back, nothing is left to show.
pub fn show_black(descriptor: OwnedFd, crtc: u32, black: u32, hold: Duration) -> Result<(), DisplayError> {
    let node = CardDescriptor(descriptor);
    let handle = |n: u32| std::num::NonZeroU32::new(n).ok_or(DisplayError::Gone);
    let (crtc, black) = (crtc::Handle::from(handle(crtc)?), framebuffer::Handle::from(handle(black)?));
    let limit = Instant::now() + BLACK_PATIENCE.saturating_mul(10);
    loop {
        match node.page_flip(crtc, black, PageFlipFlags::empty(), None) {
            Ok(()) => break,
            Err(e) if e.raw_os_error() == Some(libc::EBUSY) && Instant::now() < limit => {
                std::thread::sleep(STEP)
            }
            Err(e) if e.raw_os_error() == Some(libc::ENOENT) => return Err(DisplayError::Revoked),
            Err(e) => return Err(call("show black")(e)),
        }
    }
    let end = Instant::now() + hold;
    // The holder of a lease is no master that could let go.
    let is_lease = node.release_master_lock().is_err();
    let asked = if is_lease { EndRequest::of(&node) } else { None };
    while Instant::now() < end {
        std::thread::sleep(STEP.saturating_mul(250));
        if is_lease {
            if !node.is_lent() || asked.as_ref().is_some_and(EndRequest::is_asked) {
                break;
            }
            continue;
        }
        match node.acquire_master_lock() {
            Ok(()) => drop(node.release_master_lock()),
            Err(_) => break,
        }
    }
    Ok(())
}

/// Where a guardian is asked to end. The file is gone when it does.
struct EndRequest {
    socket: UnixDatagram,
    path: PathBuf,
}

impl EndRequest {
    fn of(node: &CardDescriptor) -> Option<Self> {
        let (_, connector) = node.connector_names().into_iter().next()?;
        Self::at(&runtime_folder()?, &connector)
    }

    fn at(folder: &Path, connector: &str) -> Option<Self> {
        let path = folder.join(format!("{SOCKET}{connector}"));
        // What a guardian that was killed has left behind.
        let _ = std::fs::remove_file(&path);
        let socket = UnixDatagram::bind(&path).ok()?;
        socket.set_nonblocking(true).ok()?;
        Some(Self { socket, path })
    }

    fn is_asked(&self) -> bool {
        self.socket.recv(&mut [0; 1]).is_ok()
    }
}

impl Drop for EndRequest {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// The user's own folder for sockets.
fn runtime_folder() -> Option<PathBuf> {
    std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from)
}

/// Asks the guardian that keeps `connector` black on a dead run's lease to end, or the only one there is, and waits until it
/// does, two seconds at most. True if there was one.
pub fn let_go(connector: Option<&str>) -> bool {
    runtime_folder().is_some_and(|folder| let_go_in(&folder, connector))
}

fn let_go_in(folder: &Path, connector: Option<&str>) -> bool {
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let named = files.filter(|file| {
        let name = file.file_name();
        let guarded = name.to_str().and_then(|name| name.strip_prefix(SOCKET));
        guarded.is_some_and(|guarded| connector.is_none_or(|wanted| wanted == guarded))
    });
    let Ok(socket) = UnixDatagram::unbound() else { return false };
    if socket.set_nonblocking(true).is_err() {
        return false;
    }
    let alive: Vec<PathBuf> =
        named.map(|file| file.path()).filter(|path| socket.connect(path).is_ok()).collect();
    let [guardian] = alive.as_slice() else { return false };
    if socket.send_to(&[1], guardian).is_err() {
        return false;
    }
    let limit = Instant::now() + GOES_WITHIN;
    while guardian.exists() && Instant::now() < limit {
        std::thread::sleep(STEP.saturating_mul(10));
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder of this test.
    fn folder(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("dpm-guard-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        std::fs::create_dir(&folder).unwrap();
        folder
    }

    fn keep(folder: &Path, connector: &str) -> std::thread::JoinHandle<bool> {
        let asked = EndRequest::at(folder, connector).expect("a socket");
        std::thread::spawn(move || {
            let limit = Instant::now() + Duration::from_secs(10);
            while !asked.is_asked() && Instant::now() < limit {
                std::thread::sleep(STEP);
            }
            Instant::now() < limit
        })
    }

    #[test]
    fn a_guardian_lets_go_of_the_connector_that_is_asked_for_and_of_no_other() {
        let folder = folder("one");
        assert!(!let_go_in(&folder, None), "nobody keeps anything");
        let (hdmi, dp) = (keep(&folder, "HDMI-A-1"), keep(&folder, "DP-1"));
        assert!(!let_go_in(&folder, Some("DP-2")));
        assert!(!let_go_in(&folder, None), "which of the two is meant?");
        assert!(let_go_in(&folder, Some("DP-1")));
        assert!(dp.join().unwrap());
        assert!(!hdmi.is_finished() && folder.join("dpm-guardian-HDMI-A-1").exists());
        assert!(let_go_in(&folder, None), "only one is left");
        assert!(hdmi.join().unwrap());
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn what_a_killed_guardian_has_left_holds_nobody_up() {
        let folder = folder("left");
        let path = folder.join("dpm-guardian-DP-1");
        drop(UnixDatagram::bind(&path).unwrap());
        assert!(path.exists());
        assert!(!let_go_in(&folder, Some("DP-1")), "nobody listens there");
        let again = keep(&folder, "DP-1");
        assert!(let_go_in(&folder, Some("DP-1")));
        assert!(again.join().unwrap());
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
