//! Orders from another process to the rig that runs in this one.
//!
//! A rig listens on a Unix socket `run-PID.sock` in the runtime folder, which must belong to this user (see
//! [`dpm_common::folder`]). Both ends ask the kernel for the identity of the other one. A connection carries one word
//! and a line feed. The first line of the answer, `heard` and the rig's file, comes at once. The second line comes
//! when the projector has obeyed, and says how it is and what is kept over restarts; if the projector has not obeyed
//! after half a second, the line says so. If the first line does not come, BLACK and SAFE are sent as a signal, which
//! needs no thread of the rig except its link's. The file `run-PID.state` then shows the result.
//!
//! The same socket takes the commands of [`crate::parameters`], which have no signal and no first line.

pub mod answer;
pub mod change;
pub mod client;
pub mod orders;
pub mod osc;
pub mod parameters;
pub mod server;
pub mod status_file;

use crate::order::Order;
use crate::parameters::command::{ParameterCommand, MAX_LINE};
use crate::telemetry::monitor::ProjectorHealth;
use dpm_common::folder::{Folder, FolderError, Owner};
use dpm_common::unix::user;
use dpm_device::link::faults;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Longest line that a client sends, with its line feed.
const MAX_WORD: usize = MAX_LINE;
/// First word of the line that confirms the arrival of an order.
const HEARD: &str = "heard";

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientRequest {
    /// An order.
    Order(Order),
    /// A look at the parameters, or a change of them.
    Parameters(ParameterCommand),
}

static RIG: OnceLock<String> = OnceLock::new();

/// Sets the rig file of this process, for clients that give it orders. The first call counts.
pub fn set_rig_name(path: &Path) {
    let path = std::fs::canonicalize(path).unwrap_or_else(|_| path.into());
    let name: String = path.display().to_string().chars().filter(|c| !c.is_control()).take(300).collect();
    let _ = RIG.set(name);
}

/// The rig file of this process, as set.
pub fn rig_name() -> &'static str {
    RIG.get().map_or("built-in demo", String::as_str)
}

/// The folder of the locks and control sockets of running rigs, from the environment: `$DPM_RUNTIME_DIR`;
/// `$XDG_RUNTIME_DIR/dpm` if that folder belongs to this user; `/run/dpm` for root, or if it belongs to this user;
/// else `dpm-UID` in the temporary folder.
pub(crate) fn runtime_path() -> PathBuf {
    let variable = |name: &str| std::env::var_os(name).filter(|dir| !dir.is_empty()).map(PathBuf::from);
    choose(&variable, user(), &|path| std::fs::metadata(path).ok().map(|about| about.uid()))
}

fn choose(
    variable: &dyn Fn(&str) -> Option<PathBuf>,
    me: u32,
    owner: &dyn Fn(&Path) -> Option<u32>,
) -> PathBuf {
    let run = Path::new("/run/dpm");
    let is_for_me = || match owner(run) {
        Some(uid) => uid == me,
        None => me == 0,
    };
    variable("DPM_RUNTIME_DIR")
        // After `su` a shell still has the variable of the first user.
        .or_else(|| {
            variable("XDG_RUNTIME_DIR").filter(|dir| owner(dir) == Some(me)).map(|dir| dir.join("dpm"))
        })
        .or_else(|| is_for_me().then(|| run.into()))
        .or_else(|| (me == 0).then(|| "/run/dpm-0".into()))
        .unwrap_or_else(|| variable("TMPDIR").unwrap_or_else(|| "/tmp".into()).join(format!("dpm-{me}")))
}

/// The runtime folder of this process; created if it is missing.
///
/// # Errors
/// It cannot be created, or does not belong to this user.
pub fn runtime_folder() -> Result<Folder, FolderError> {
    Folder::make(&runtime_path(), Owner::Own)
}

fn socket_name(pid: u32) -> String {
    format!("run-{pid}.sock")
}

fn state_name(pid: u32) -> String {
    format!("run-{pid}.state")
}

/// True when the projector is in the state that `order` asks for. Latched faults and the end of a run are as dark as
/// BLACK.
pub fn is_obeyed(order: Order, health: ProjectorHealth) -> bool {
    use ProjectorHealth as H;
    match order {
        Order::Black => matches!(health, H::Black | H::Faulted(_) | H::Stopped),
        Order::Freeze => health == H::Frozen,
        Order::Safe => match health {
            H::Faulted(mask) => mask & faults::HOST_SAFE != 0,
            H::Stopped => true,
            _ => false,
        },
        Order::Arm => health == H::Up,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_runtime_folder_is_the_first_that_is_this_users() {
        let choose = |set: &[(&str, &str)], me, owners: &[(&str, u32)]| {
            choose(&|name| set.iter().find(|(n, _)| *n == name).map(|(_, v)| PathBuf::from(v)), me, &|path| {
                owners.iter().find(|(p, _)| Path::new(p) == path).map(|(_, uid)| *uid)
            })
        };
        let xdg = [("XDG_RUNTIME_DIR", "/run/user/7")];
        let both = [("DPM_RUNTIME_DIR", "/x"), xdg[0]];
        let owned = [("/run/user/7", 7), ("/run/dpm", 9)];
        assert_eq!(choose(&both, 7, &owned), Path::new("/x"));
        assert_eq!(choose(&xdg, 7, &owned), Path::new("/run/user/7/dpm"));
        // Another user's folder, as after `su`.
        assert_eq!(choose(&xdg, 8, &owned), Path::new("/tmp/dpm-8"));
        assert_eq!(choose(&xdg, 9, &owned), Path::new("/run/dpm"));
        assert_eq!(choose(&xdg, 0, &owned), Path::new("/run/dpm-0"));
        assert_eq!(choose(&xdg, 0, &[]), Path::new("/run/dpm"));
        assert_eq!(choose(&[("TMPDIR", "/t")], 8, &[]), Path::new("/t/dpm-8"));
    }

    #[test]
    fn dark_is_confirmed_by_a_dark_projector_only() {
        use ProjectorHealth as H;
        for health in [H::Up, H::Frozen, H::Connecting, H::Lost] {
            assert!(!is_obeyed(Order::Black, health) && !is_obeyed(Order::Safe, health), "{health}");
        }
        assert!(is_obeyed(Order::Black, H::Black) && !is_obeyed(Order::Safe, H::Black));
        assert!(is_obeyed(Order::Safe, H::Faulted(faults::HOST_SAFE | faults::LAMP)));
        assert!(!is_obeyed(Order::Safe, H::Faulted(faults::LAMP)));
    }
}
