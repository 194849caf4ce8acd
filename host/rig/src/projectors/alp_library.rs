//! The vendor's libraries for a ViALUX ALP, by the look of their files. None is loaded: to load a library is to run it,
//! and a rig file may name any.

use dpm_common::unix::{user, user_name};
use dpm_device::regular_file;
use std::io::Read;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// What to do where there is none.
pub const REMEDY: &str = "install the vendor's ALP for Linux, see docs/ALP.md";
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
/// The list that `ldconfig` makes of the libraries in all folders that `/etc/ld.so.conf` names.
const CACHE: &str = "etc/ld.so.cache";
/// Bytes of the longest list that is read; a large system has some hundred thousand.
const MOST_CACHE_BYTES: u64 = 1 << 24;

/// The ALP libraries below `root`, in the folders of systems.
pub fn installed(root: &Path) -> Vec<PathBuf> {
    FOLDERS
        .iter()
        .flat_map(|folder| NAMES.iter().map(move |name| Path::new(folder).join(name)))
        .filter(|file| root.join(file).exists())
        .map(|file| Path::new("/").join(file))
        .collect()
}

/// Where the loader finds the library `name`: in the folders of `search` (`LD_LIBRARY_PATH`), in its list, or where
/// systems keep libraries.
fn of_loader(root: &Path, search: &str, name: &str) -> Option<PathBuf> {
    let named =
        search.split(':').filter(|folder| !folder.is_empty()).map(|folder| Path::new(folder).join(name));
    let listed = regular_file::read(&root.join(CACHE), MOST_CACHE_BYTES).unwrap_or_default();
    let listed: Vec<PathBuf> = listed
        .split(|byte| *byte == 0)
        .filter_map(|text| std::str::from_utf8(text).ok())
        .filter_map(|text| text.find('/').and_then(|at| text.get(at..)))
        .map(PathBuf::from)
        .filter(|path| path.file_name().is_some_and(|file| file == name))
        .collect();
    let system = FOLDERS.iter().map(|folder| Path::new("/").join(folder).join(name));
    let there = |file: &PathBuf| root.join(file.strip_prefix("/").unwrap_or(file)).exists();
    named.filter(|file| file.exists()).chain(listed.into_iter().chain(system).filter(there)).next()
}

/// The library that a rig file names, or without a name the newest one that the system has; and a doubt about it, empty if
/// there is none.
///
/// # Errors
/// Which library is missing, or is none for this machine.
pub fn find(named: Option<&Path>) -> Result<(PathBuf, String), String> {
    let search = std::env::var("LD_LIBRARY_PATH").unwrap_or_default();
    let of_loader = |name: &str| of_loader(Path::new("/"), &search, name);
    let file = match named.map(|path| (path, path.to_str())) {
        // The loader looks for a name alone where the system keeps its libraries.
        Some((path, Some(name))) if !name.contains('/') => of_loader(name).ok_or(path.display().to_string()),
        Some((path, _)) => Ok(path.to_owned()),
        None => NAMES.iter().find_map(|name| of_loader(name)).ok_or("an ALP library".into()),
    };
    let file = file.map_err(|name| format!("{name}: not found"))?;
    let doubt = look_at(&file)?;
    Ok((file, doubt))
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

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A folder of a test that stands for the root of a system.
    fn root(name: &str) -> PathBuf {
        std::env::temp_dir().join(format!("dpm-alp-{}-{name}", std::process::id()))
    }

    #[test]
    fn installed_libraries_are_listed() {
        let root = root("installed");
        let folder = root.join("usr/lib/x86_64-linux-gnu");
        std::fs::create_dir_all(&folder).unwrap();
        assert!(installed(&root).is_empty());
        for name in ["libalp43.so", "libalp50.so", "libalps.so"] {
            std::fs::write(folder.join(name), "").unwrap();
        }
        let found = installed(&root);
        std::fs::remove_dir_all(&root).unwrap();
        let expected = ["libalp50.so", "libalp43.so"];
        assert_eq!(found, expected.map(|name| Path::new("/usr/lib/x86_64-linux-gnu").join(name)));
    }

    /// A run ends where the look finds no library, so the look finds what the loader finds.
    #[test]
    fn a_name_is_looked_for_where_the_loader_looks() {
        let root = root("loader");
        for folder in ["etc", "opt/vialux", "named"] {
            std::fs::create_dir_all(root.join(folder)).unwrap();
        }
        let find = |search: &str| of_loader(&root, search, "libalp43.so");
        assert_eq!(find(""), None);
        std::fs::write(
            root.join(CACHE),
            b"glibc-ld.so.cache1.1\0\x01/opt/vialux/libalp43.so\0/lib/libm.so.6\0",
        )
        .unwrap();
        assert_eq!(find(""), None, "listed, and gone since");
        std::fs::write(root.join("opt/vialux/libalp43.so"), "").unwrap();
        assert_eq!(find(""), Some("/opt/vialux/libalp43.so".into()));
        let named = root.join("named/libalp43.so");
        std::fs::write(&named, "").unwrap();
        assert_eq!(find(&format!("/nowhere::{}", root.join("named").display())), Some(named));
        std::fs::remove_dir_all(&root).unwrap();
    }

    /// Found in use, R10: the constructor of a library that a rig file named ran as whoever asked the doctor.
    #[test]
    fn a_library_is_judged_by_its_file() {
        let file = std::env::temp_dir().join(format!("dpm-libalp-{}.so", std::process::id()));
        let judged = |bytes: &[u8], mode| {
            std::fs::write(&file, bytes).unwrap();
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
            find(Some(&file)).map(|(_, doubt)| doubt)
        };
        // This test is a shared object too: it may be loaded anywhere.
        let head = std::fs::read("/proc/self/exe").unwrap()[..64].to_vec();
        assert_eq!(judged(&head, 0o644), Ok(String::new()));
        assert!(judged(&head, 0o666).unwrap().contains("others may change it"));
        for byte in [0, 4, 16, 18] {
            let mut other = head.clone();
            other[byte] ^= 1;
            assert!(judged(&other, 0o644).unwrap_err().contains("no library"), "byte {byte}");
        }
        assert!(judged(&head[..10], 0o644).is_err());
        std::fs::remove_file(&file).unwrap();
        assert!(find(Some(&file)).is_err());
        assert!(find(Some(Path::new("libalp-of-nobody.so"))).unwrap_err().contains("not found"));
    }
}
