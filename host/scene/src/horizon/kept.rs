//! Horizons on disk, so that the second start with a mesh need not work them out.
//!
//! A file holds the triangles that it is about beside their horizons. So it serves these triangles and no others, whatever its name says, and a
//! checksum shows damage. Anything else than the file that this version would write is named, not used, and written anew. What no file can be read
//! or written for is worked out as if there were none.
//!
//! The folder and the file must belong to this user, because a horizon is believed: nothing here proves that a ray leaves. A file that somebody
//! wrote on purpose, checksum and all, could leave out shadows and light between the parts of a body, or have more rays walked. It can do no more:
//! a horizon is a step of 0 to 15 of one triangle, and light is limited behind the picture.

use super::{horizons, Horizon};
use dpm_common::fnv::Fnv;
use dpm_common::folder::{Folder, FolderError, Owner, UNFINISHED};
use dpm_device::link::crc32c;
use glam::Vec3;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::SystemTime;

/// What the horizons of given triangles depend on besides them. A test holds the horizons of a mesh to this number.
const VERSION: u32 = 1;
/// The first bytes of a file.
const MAGIC: [u8; 12] = *b"dpm horizons";
/// Magic, version, triangles, and the checksum of all that follows.
const HEAD: usize = MAGIC.len() + 4 + 4 + 4;
/// Bytes of a triangle: three corners of three f32, and its horizon.
const EACH: usize = size_of::<[Vec3; 3]>() + size_of::<Horizon>();
/// Of fewer triangles they are worked out in less than a tenth of a second.
const FEWEST: usize = 4096;
/// Bytes that the files of a folder may have together: seven million triangles.
const MOST_BYTES: u64 = 1 << 28;

static FOLDER: OnceLock<PathBuf> = OnceLock::new();

/// Names the folder in which this process keeps horizons. The first call counts; without one they are not kept.
pub fn keep_in(folder: PathBuf) {
    let _ = FOLDER.set(folder);
}

/// The folder in which this process keeps horizons.
pub fn folder() -> Option<&'static Path> {
    FOLDER.get().map(PathBuf::as_path)
}

/// As [`horizons`], from the folder of [`keep_in`] where they lie there.
pub fn kept_horizons(triangles: &[[Vec3; 3]]) -> Vec<Horizon> {
    match folder() {
        Some(folder) => HorizonFolder { path: folder, most_bytes: MOST_BYTES }.horizons(triangles),
        None => horizons(triangles),
    }
}

/// A folder with horizons.
#[derive(Clone, Copy, Debug)]
struct HorizonFolder<'a> {
    path: &'a Path,
    /// Bytes of all its files.
    most_bytes: u64,
}

/// Why there are no horizons to be read.
#[derive(Debug, thiserror::Error)]
enum KeptError {
    #[error(transparent)]
    Folder(#[from] FolderError),
    #[error("{0}: {1}")]
    Damaged(String, &'static str),
}

impl HorizonFolder<'_> {
    fn horizons(&self, triangles: &[[Vec3; 3]]) -> Vec<Horizon> {
        if triangles.len() < FEWEST {
            return horizons(triangles);
        }
        match self.read(triangles) {
            Ok(kept) => return kept,
            Err(KeptError::Folder(e)) if e.is_missing() => {}
            Err(e) => tracing::info!("horizons are worked out anew: {e}"),
        }
        let made = horizons(triangles);
        if let Err(e) = self.write(triangles, &made) {
            tracing::info!("horizons cannot be kept, so the next start works them out again: {e}");
        }
        made
    }

    fn read(&self, triangles: &[[Vec3; 3]]) -> Result<Vec<Horizon>, KeptError> {
        let folder = Folder::open(self.path, Owner::OwnOrAnyForRoot)?;
        let name = name_of(triangles);
        let bytes = folder.read(&name, length_of(triangles))?;
        content(&bytes, triangles).map_err(|why| KeptError::Damaged(name, why))
    }

    fn write(&self, triangles: &[[Vec3; 3]], made: &[Horizon]) -> Result<(), FolderError> {
        let length = length_of(triangles);
        if length > self.most_bytes {
            return Ok(());
        }
        let folder = Folder::make(self.path, Owner::OwnOrAnyForRoot)?;
        self.make_room(&folder, length)?;
        folder.replace(&name_of(triangles), &bytes_of(triangles, made))
    }

    /// Removes the files that were written first until so many bytes have room.
    fn make_room(&self, folder: &Folder, bytes: u64) -> Result<(), FolderError> {
        let mut files: Vec<(SystemTime, u64, String)> = Vec::new();
        for name in folder.names()?.into_iter().filter(|name| is_ours(name)) {
            // Another process may have removed it.
            if let Ok(about) = fs::symlink_metadata(folder.path_to(&name)) {
                files.push((about.modified().unwrap_or(SystemTime::UNIX_EPOCH), about.len(), name));
            }
        }
        files.sort();
        let mut all: u64 = files.iter().map(|file| file.1).sum();
        for (_, length, name) in files {
            if all + bytes <= self.most_bytes {
                break;
            }
            folder.remove(&name)?;
            all -= length;
        }
        Ok(())
    }
}

/// A file with horizons, or one that a killed process has not finished.
fn is_ours(name: &str) -> bool {
    name.starts_with("horizons-") || name.starts_with(UNFINISHED)
}

fn corners_of(triangles: &[[Vec3; 3]]) -> &[u8] {
    bytemuck::cast_slice(triangles.as_flattened())
}

fn name_of(triangles: &[[Vec3; 3]]) -> String {
    let mut hash = Fnv::default();
    hash.add(corners_of(triangles));
    format!("horizons-{VERSION}-{}", hash.text())
}

fn length_of(triangles: &[[Vec3; 3]]) -> u64 {
    (HEAD + triangles.len() * EACH) as u64
}

/// The words before the checksum.
fn head_of(triangles: &[[Vec3; 3]]) -> [u8; HEAD - 4] {
    let mut head = [0; HEAD - 4];
    head[..12].copy_from_slice(&MAGIC);
    head[12..16].copy_from_slice(&VERSION.to_le_bytes());
    head[16..].copy_from_slice(&(triangles.len() as u32).to_le_bytes());
    head
}

fn bytes_of(triangles: &[[Vec3; 3]], made: &[Horizon]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEAD + triangles.len() * EACH);
    bytes.extend(head_of(triangles));
    bytes.extend([0; 4]);
    bytes.extend(corners_of(triangles));
    bytes.extend(made.as_flattened().iter().flat_map(|word| word.to_le_bytes()));
    let sum = crc32c(&bytes[HEAD..]);
    bytes[HEAD - 4..HEAD].copy_from_slice(&sum.to_le_bytes());
    bytes
}

/// The horizons of these triangles from the bytes of a file; else what is wrong with it.
fn content(bytes: &[u8], triangles: &[[Vec3; 3]]) -> Result<Vec<Horizon>, &'static str> {
    let corners = corners_of(triangles);
    if bytes.len() as u64 != length_of(triangles) {
        return Err("it is too short");
    }
    let (head, body) = bytes.split_at(HEAD);
    if head[..HEAD - 4] != head_of(triangles) {
        return Err("it is no file of this version about so many triangles");
    }
    if head[HEAD - 4..] != crc32c(body).to_le_bytes() {
        return Err("it is damaged");
    }
    let (of, kept) = body.split_at(corners.len());
    if of != corners {
        return Err("it is about other triangles");
    }
    let word = |bytes: &[u8]| u32::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    let horizon = |bytes: &[u8]| std::array::from_fn(|i| word(&bytes[4 * i..]));
    Ok(kept.chunks_exact(size_of::<Horizon>()).map(horizon).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::horizon::CLOSED;
    use std::os::unix::fs::PermissionsExt;

    /// A landscape of whole numbers: the same on every machine.
    fn landscape(side: u32, seed: u32) -> Vec<[Vec3; 3]> {
        let height = |x: u32, z: u32| {
            let mixed =
                (x.wrapping_mul(73_856_093) ^ z.wrapping_mul(19_349_663) ^ seed).wrapping_mul(2_654_435_761);
            (mixed >> 29) as f32
        };
        let at = |x: u32, z: u32| Vec3::new(4.0 * x as f32, height(x, z), 4.0 * z as f32);
        let cell = |x: u32, z: u32| {
            [[at(x, z), at(x, z + 1), at(x + 1, z)], [at(x + 1, z), at(x, z + 1), at(x + 1, z + 1)]]
        };
        (0..side * side).flat_map(|i| cell(i % side, i / side)).collect()
    }

    struct Bench {
        path: PathBuf,
    }

    impl Bench {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("dpm-horizons-{name}-{}", std::process::id()));
            let _ = fs::remove_dir_all(&path);
            Self { path }
        }

        fn folder(&self) -> HorizonFolder<'_> {
            HorizonFolder { path: &self.path, most_bytes: MOST_BYTES }
        }

        fn names(&self) -> Vec<String> {
            let name =
                |entry: std::io::Result<fs::DirEntry>| entry.unwrap().file_name().into_string().unwrap();
            let mut names: Vec<_> = fs::read_dir(&self.path).unwrap().map(name).collect();
            names.sort();
            names
        }
    }

    impl Drop for Bench {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.path);
        }
    }

    /// More triangles than the fewest that are kept.
    const SIDE: u32 = 46;

    /// Horizons that nobody works out, to see where they come from.
    fn others(count: usize) -> Vec<Horizon> {
        (0..count as u32).map(|i| [i, 7 * i, !i]).collect()
    }

    #[test]
    fn what_was_kept_is_read_and_not_worked_out() {
        let bench = Bench::new("read");
        let (mesh, folder) = (landscape(SIDE, 1), bench.folder());
        let made = folder.horizons(&mesh);
        assert!(made == horizons(&mesh) && made.iter().any(|horizon| *horizon != CLOSED));
        assert_eq!(bench.names(), [name_of(&mesh)]);
        assert_eq!(folder.read(&mesh).unwrap(), made);
        folder.write(&mesh, &others(mesh.len())).unwrap();
        assert_eq!(folder.horizons(&mesh), others(mesh.len()));
        // Of few triangles nothing is kept.
        let few = landscape(20, 1);
        assert_eq!(folder.horizons(&few), horizons(&few));
        assert_eq!(bench.names().len(), 1);
    }

    /// Every byte that is another one, every length, another version and another mesh: the file is not used, and is written anew.
    #[test]
    fn a_file_that_is_not_as_it_was_written_is_not_used() {
        let bench = Bench::new("damaged");
        let (mesh, folder) = (landscape(SIDE, 2), bench.folder());
        let made = folder.horizons(&mesh);
        let file = bench.path.join(name_of(&mesh));
        let whole = fs::read(&file).unwrap();
        assert_eq!(content(&whole, &mesh).as_deref(), Ok(&made[..]));
        for at in (0..whole.len()).step_by(97).chain(0..HEAD).chain([whole.len() - 1]) {
            for bit in [0, 7] {
                let mut bytes = whole.clone();
                bytes[at] ^= 1 << bit;
                assert!(content(&bytes, &mesh).is_err(), "byte {at}, bit {bit}");
            }
        }
        for length in (0..whole.len()).step_by(1009).chain([HEAD - 1, HEAD, whole.len() - 1]) {
            assert!(content(&whole[..length], &mesh).is_err(), "{length} bytes");
        }
        let of_another = bytes_of(&landscape(SIDE, 3), &made);
        assert_eq!(content(&of_another, &mesh), Err("it is about other triangles"));
        let [mut of_another_version, longer] = [whole.clone(), [&whole[..], &[0]].concat()];
        of_another_version[12] += 1;
        for bytes in [&of_another, &of_another_version, &longer, &whole[..whole.len() / 2], &[]] {
            fs::write(&file, bytes).unwrap();
            assert!(folder.read(&mesh).is_err());
            assert_eq!(folder.horizons(&mesh), made);
            assert!(fs::read(&file).unwrap() == whole, "it was not written anew");
        }
    }

    /// A link, a folder that others may write to, one that is a file, and one in which nothing can be written: the horizons are there all the same.
    #[test]
    fn what_cannot_be_used_is_gone_without() {
        let bench = Bench::new("unusable");
        let (mesh, folder) = (landscape(SIDE, 4), bench.folder());
        folder.write(&mesh, &others(mesh.len())).unwrap();
        let (file, elsewhere) = (bench.path.join(name_of(&mesh)), bench.path.join("elsewhere"));
        fs::rename(&file, &elsewhere).unwrap();
        std::os::unix::fs::symlink(&elsewhere, &file).unwrap();
        assert_eq!(folder.horizons(&mesh), horizons(&mesh));
        assert!(fs::read(&elsewhere).unwrap() == bytes_of(&mesh, &others(mesh.len())), "a link was followed");
        folder.write(&mesh, &others(mesh.len())).unwrap();
        fs::set_permissions(&bench.path, fs::Permissions::from_mode(0o777)).unwrap();
        assert_eq!(folder.horizons(&mesh), horizons(&mesh));
        fs::remove_dir_all(&bench.path).unwrap();
        fs::write(&bench.path, "").unwrap();
        assert_eq!(folder.horizons(&mesh), horizons(&mesh));
        fs::remove_file(&bench.path).unwrap();
        // A device on which every write says that the disk is full, in the place of the folder's parent.
        let full = HorizonFolder { path: Path::new("/dev/full/horizons"), most_bytes: MOST_BYTES };
        assert_eq!(full.horizons(&mesh), horizons(&mesh));
        // Nobody, not even root, can make a file there.
        let read_only = HorizonFolder { path: Path::new("/proc/self"), most_bytes: MOST_BYTES };
        assert!(read_only.write(&mesh, &others(mesh.len())).is_err());
        assert_eq!(read_only.horizons(&mesh), horizons(&mesh));
    }

    #[test]
    fn the_oldest_files_make_room() {
        let bench = Bench::new("room");
        let meshes: Vec<_> = (0..4).map(|seed| landscape(SIDE, seed)).collect();
        let length = length_of(&meshes[0]);
        let folder = HorizonFolder { most_bytes: 2 * length + 10, ..bench.folder() };
        let age = |name: &str, seconds: u64| {
            let file = fs::File::options().write(true).open(bench.path.join(name)).unwrap();
            file.set_modified(SystemTime::now() - std::time::Duration::from_secs(seconds)).unwrap();
        };
        for (mesh, seconds) in meshes[..2].iter().zip([20, 40]) {
            folder.write(mesh, &others(mesh.len())).unwrap();
            age(&name_of(mesh), seconds);
        }
        let unfinished = format!("{UNFINISHED}1-1");
        for name in [unfinished.as_str(), "of-somebody-else"] {
            fs::write(bench.path.join(name), [0; 64]).unwrap();
            age(name, 60);
        }
        folder.write(&meshes[2], &others(meshes[2].len())).unwrap();
        let mut left = [name_of(&meshes[0]), name_of(&meshes[2]), "of-somebody-else".into()];
        left.sort();
        assert_eq!(bench.names(), left);
        // What would fill more than all of it is not kept.
        let small = HorizonFolder { most_bytes: length - 1, ..folder };
        small.write(&meshes[3], &others(meshes[3].len())).unwrap();
        assert_eq!(bench.names(), left);
    }

    /// Whoever changes what horizons are makes a new version, so that none of the old ones is used.
    #[test]
    #[cfg(target_arch = "x86_64")]
    fn other_horizons_have_another_version() {
        let mut hash = Fnv::default();
        horizons(&landscape(SIDE, 5)).as_flattened().iter().for_each(|word| hash.add(&word.to_le_bytes()));
        assert_eq!((VERSION, hash.text().as_str()), (1, "009b791a707c662b"));
    }
}
