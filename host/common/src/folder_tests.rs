use super::*;
use std::os::unix::fs::{chown, symlink, PermissionsExt};

/// An empty folder that is removed after the test.
struct EmptyFolder(PathBuf);

impl EmptyFolder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-folder-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for EmptyFolder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

const NOBODY: u32 = 65534;

/// Found in use, R7: a folder that somebody else made, or can write to, is refused whatever it contains.
#[test]
fn r7_only_a_folder_of_our_own_is_used() {
    let place = EmptyFolder::new("whose");
    let dir = place.0.join("dpm-0");
    let made = Folder::make(&dir, Owner::Own).unwrap();
    assert_eq!(fs::metadata(&dir).unwrap().permissions().mode() & 0o777, 0o700);
    assert_eq!(made.owner(), user());
    for mode in [0o770, 0o707, 0o1777] {
        fs::set_permissions(&dir, fs::Permissions::from_mode(mode)).unwrap();
        let told = Folder::make(&dir, Owner::Own).unwrap_err().to_string();
        assert!(told.contains("can be written by others") && told.contains("chmod go-w"), "{told}");
    }
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o755)).unwrap();
    Folder::make(&dir, Owner::Own).unwrap();
    let alias = place.0.join("alias");
    symlink(&dir, &alias).unwrap();
    let told = Folder::make(&alias, Owner::Own).unwrap_err().to_string();
    assert!(told.contains("is a link or a file"), "{told}");
    let file = place.0.join("file");
    fs::write(&file, b"").unwrap();
    assert!(matches!(Folder::make(&file, Owner::Own), Err(FolderError::NotOurs { .. })));
    assert!(Folder::open(&place.0.join("none"), Owner::Own).unwrap_err().is_missing());
    if user() == 0 {
        chown(&dir, Some(NOBODY), None).unwrap();
        let told = Folder::make(&dir, Owner::Own).unwrap_err().to_string();
        assert!(told.contains("belongs to") && told.contains("not to root"), "{told}");
        assert_eq!(Folder::open(&dir, Owner::OwnOrAnyForRoot).unwrap().owner(), NOBODY);
    }
}

/// Found in use, R7: a link, a second name, a FIFO or a file of another user in place of a lock file is not written to.
#[test]
fn r7_files_that_others_planted_are_refused_untouched() {
    let place = EmptyFolder::new("planted");
    let folder = Folder::make(&place.0.join("ours"), Owner::Own).unwrap();
    let at = |name: &str| folder.path().join(name);
    let victim = place.0.join("victim");
    fs::write(&victim, b"precious").unwrap();
    symlink(&victim, at("link")).unwrap();
    fs::hard_link(&victim, at("hard")).unwrap();
    symlink(place.0.join("not-there"), at("dangling")).unwrap();
    fs::create_dir(at("folder")).unwrap();
    let fifo = std::process::Command::new("mkfifo").arg(at("fifo")).status();
    assert!(fifo.expect("coreutils").success());
    if user() == 0 {
        fs::write(at("theirs"), b"").unwrap();
        chown(at("theirs"), Some(NOBODY), None).unwrap();
    }
    for name in ["link", "hard", "dangling", "folder", "fifo", "theirs"] {
        if name == "theirs" && user() != 0 {
            continue;
        }
        let error = folder.open_file(name, true).unwrap_err();
        assert!(error.to_string().contains(name), "{error}");
        assert!(open_own_file(&at(name)).is_err(), "{name}");
        if name != "folder" {
            assert!(matches!(error, FolderError::NotOurs { .. }), "{name}: {error}");
        }
    }
    assert_eq!(fs::read(&victim).unwrap(), b"precious");
    assert!(!place.0.join("not-there").exists());
}

#[test]
fn a_file_is_replaced_whole_read_with_a_limit_and_removed() {
    let place = EmptyFolder::new("files");
    let folder = Folder::make(&place.0.join("ours"), Owner::Own).unwrap();
    assert!(folder.read("a", 10).unwrap_err().is_missing());
    folder.remove("a").unwrap();
    folder.replace("a", b"old").unwrap();
    folder.replace("a", b"new").unwrap();
    assert_eq!(folder.read("a", 3).unwrap(), b"new");
    assert!(folder.read("a", 2).unwrap_err().to_string().contains("too long"));
    assert_eq!(folder.names().unwrap(), ["a"]);
    // The same folder is used, even if its path names another one later.
    fs::rename(folder.path(), place.0.join("moved")).unwrap();
    folder.replace("b", b"").unwrap();
    assert!(place.0.join("moved/b").exists());
    folder.remove("a").unwrap();
    assert_eq!(folder.names().unwrap(), ["b"]);
    // A planted link is replaced, not followed.
    let victim = place.0.join("victim");
    fs::write(&victim, b"precious").unwrap();
    symlink(&victim, place.0.join("moved/c")).unwrap();
    folder.replace("c", b"mine").unwrap();
    assert_eq!(fs::read(&victim).unwrap(), b"precious");
}

/// Found in use, R4: an order needs no room where its bytes were allocated before.
#[test]
fn a_file_is_written_over_and_renamed_in_its_own_blocks() {
    let place = EmptyFolder::new("over");
    let folder = Folder::make(&place.0.join("ours"), Owner::Own).unwrap();
    let number = |name: &str| fs::metadata(folder.path().join(name)).unwrap().ino();
    folder.replace("reserve", b"00000000").unwrap();
    let before = number("reserve");
    folder.overwrite("reserve", b"12345678").unwrap();
    folder.replace("order", b"old").unwrap();
    folder.rename("reserve", "order").unwrap();
    assert_eq!((folder.read("order", 8).unwrap(), number("order")), (b"12345678".to_vec(), before));
    assert!(folder.read("reserve", 8).unwrap_err().is_missing());
    // Shorter content leaves no end of the old one.
    folder.overwrite("order", b"abc").unwrap();
    assert_eq!(folder.read("order", 8).unwrap(), b"abc");
    assert!(folder.overwrite("none", b"x").unwrap_err().is_missing());
    let victim = place.0.join("victim");
    fs::write(&victim, b"precious").unwrap();
    symlink(&victim, folder.path().join("link")).unwrap();
    assert!(folder.overwrite("link", b"x").unwrap_err().to_string().contains("is a link"));
    assert_eq!(fs::read(&victim).unwrap(), b"precious");
}
