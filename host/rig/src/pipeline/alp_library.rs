//! What `dpm doctor` says of the vendor's libraries for a ViALUX ALP. It looks at them and loads none: to load a library
//! is to run it, and a rig file may name any.

use super::{Finding, State};
use dpm_common::unix::{user, user_name};
use dpm_device::regular_file;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// Where systems keep libraries.
const FOLDERS: [&str; 6] = [
    "usr/lib/x86_64-linux-gnu",
    "usr/lib/aarch64-linux-gnu",
    "usr/lib64",
    "usr/lib",
    "usr/local/lib",
    "usr/local/lib64",
];
/// The vendor's libraries, the newest first.
const NAMES: [&str; 6] =
    ["libalp51.so", "libalp50.so", "libalp44.so", "libalp43.so", "libalp42.so", "libalp41.so"];
/// Bytes of the head of an ELF file up to the machine that it is for.
const HEAD: u64 = 20;

/// The libraries of these names below `root`.
fn installed(root: &Path, names: &[&str]) -> Vec<PathBuf> {
    let all = FOLDERS.iter().flat_map(|folder| names.iter().map(move |name| Path::new(folder).join(name)));
    all.filter(|file| root.join(file).exists()).map(|file| Path::new("/").join(file)).collect()
}

/// The library that a rig file names, or without a name the one that the system has, by the look of its file.
pub(super) fn library(named: Option<&Path>) -> Finding {
    let name = "projector";
    let missing = |found: String| {
        Finding::new(name, State::Missing, found, "install the vendor's ALP for Linux, see docs/ALP.md")
    };
    let of_loader = |name: &str| installed(Path::new("/"), &[name]).into_iter().next();
    let file = match named.map(|path| (path, path.to_str())) {
        // The loader looks for a name alone where the system keeps its libraries.
        Some((path, Some(name))) if !name.contains('/') => of_loader(name).ok_or(path.display().to_string()),
        Some((path, _)) => Ok(path.to_owned()),
        None => NAMES.iter().find_map(|name| of_loader(name)).ok_or("an ALP library".into()),
    };
    match file.map_err(|name| format!("{name}: not found")).and_then(|file| Ok((look_at(&file)?, file))) {
        Err(why) => missing(format!("ALP: {why}")),
        Ok((doubt, file)) => {
            let found = format!("ALP: {} is a library for this machine{doubt}", file.display());
            let state = if doubt.is_empty() { State::Ok } else { State::Warning };
            let remedy =
                "`dpm doctor --load-libraries RIG.toml` runs it, and asks the device what it can show";
            Finding::new(name, state, found, remedy)
        }
    }
}

/// Reads the head of a library and who may change it. Returns a doubt, or nothing.
///
/// # Errors
/// It is no library for this machine.
fn look_at(file: &Path) -> Result<String, String> {
    let failed = |e: std::io::Error| format!("{}: {e}", file.display());
    let (opened, _) = regular_file::open(file).map_err(failed)?;
    let about = opened.metadata().map_err(failed)?;
    let mut head = Vec::new();
    opened.take(HEAD).read_to_end(&mut head).map_err(failed)?;
    let machine: u16 = match std::env::consts::ARCH {
        "x86_64" => 62,
        "aarch64" => 183,
        other => return Err(format!("{}: unknown machine {other}", file.display())),
    };
    // 64 bits, little-endian, a shared object.
    let is_elf = head.starts_with(b"\x7fELF\x02\x01") && head.get(16..18) == Some(&3u16.to_le_bytes());
    if !is_elf || head.get(18..20) != Some(&machine.to_le_bytes()) {
        return Err(format!("{} is no library for this machine", file.display()));
    }
    let (owner, mode) = (about.uid(), about.mode());
    Ok(if mode & 0o022 != 0 {
        format!("; others may change it (mode {:o})", mode & 0o7777)
    } else if ![0, user()].contains(&owner) {
        format!("; it belongs to {}", user_name(owner))
    } else {
        String::new()
    })
}

/// The ALP libraries below `root`.
pub(super) fn libraries(root: &Path) -> Finding {
    let found = installed(root, &NAMES);
    if found.is_empty() {
        let remedy = "needed only for a ViALUX ALP: install the vendor's ALP for Linux";
        return Finding::new("ALP library", State::Info, "none", remedy);
    }
    let found: Vec<String> = found.iter().map(|file| file.display().to_string()).collect();
    Finding::new("ALP library", State::Ok, found.join(", "), "")
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn installed_libraries_are_listed() {
        let root = std::env::temp_dir().join(format!("dpm-doctor-alp-{}", std::process::id()));
        let folder = root.join("usr/lib/x86_64-linux-gnu");
        std::fs::create_dir_all(&folder).unwrap();
        assert_eq!(libraries(&root).state, State::Info);
        for name in ["libalp43.so", "libalp50.so", "libalps.so"] {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let finding = libraries(&root);
        std::fs::remove_dir_all(&root).unwrap();
        let expected = "/usr/lib/x86_64-linux-gnu/libalp50.so, /usr/lib/x86_64-linux-gnu/libalp43.so";
        assert_eq!((finding.state, finding.found.as_str()), (State::Ok, expected));
    }

    /// Found in use, R10: the constructor of a library that a rig file named ran as whoever asked the doctor.
    #[test]
    fn a_library_is_judged_by_its_file() {
        let file = std::env::temp_dir().join(format!("dpm-doctor-libalp-{}.so", std::process::id()));
        let judged = |bytes: &[u8], mode| {
            std::fs::write(&file, bytes).unwrap();
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
            library(Some(&file)).state
        };
        // This test is a shared object too: it may be loaded anywhere.
        let head = std::fs::read("/proc/self/exe").unwrap()[..64].to_vec();
        assert_eq!(judged(&head, 0o644), State::Ok);
        assert_eq!(judged(&head, 0o666), State::Warning);
        for byte in [0, 4, 16, 18] {
            let mut other = head.clone();
            other[byte] ^= 1;
            assert_eq!(judged(&other, 0o644), State::Missing, "byte {byte}");
        }
        assert_eq!(judged(&head[..10], 0o644), State::Missing);
        std::fs::remove_file(&file).unwrap();
        assert_eq!(library(Some(&file)).state, State::Missing);
        assert_eq!(library(Some(Path::new("libalp-of-nobody.so"))).state, State::Missing);
    }
}
