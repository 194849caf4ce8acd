//! The entries of a calibration file into the devices that it describes, and into the one that is the projector.
//!
//! A file that describes several devices is a question to the operator, unless the names of its entries (`proj_K` beside
//! `cam_K`) leave one answer.

mod lens;

use super::entries::{joined, Entries, FileEntry, Matrix};
use super::names::{meaning, EntryOwner, Role};
use super::{pose, rotation, Intrinsics, PoseFrame, Purpose, ReadOptions, StorageError, StoredCalibration};
use dpm_device::planes::Raster;
use dpm_scene::geometry::projector::ProjectorCamera;
use glam::{DAffine3, DMat3, DVec3};
use lens::{check_mirror, check_unused_lens, is_fisheye, lens};
use std::collections::{BTreeMap, BTreeSet};

/// Poses of many views, of which none is the projector's.
const VIEWS: &[&str] = &["extrinsic_parameters", "Extrinsic_Parameters", "rvecs", "tvecs"];
/// Focal lengths below this share of the raster's width are no pixels: the view would be wider than 168 degrees.
const LEAST_FOCAL: f64 = 0.05;
/// A principal point farther from the middle of the columns than this share of the width is rare: lenses shift up and down.
const RARE_SHIFT: f64 = 0.2;

/// Entries with known names, and devices, beyond which a file is no calibration.
const MOST_KNOWN: usize = 4096;
const MOST_DEVICES: usize = 64;

/// One entry whose name is known.
struct NamedEntry<'a> {
    section: &'a str,
    name: &'a str,
    owner: EntryOwner,
    role: Role,
    from_camera: bool,
    entry: &'a FileEntry,
}

impl NamedEntry<'_> {
    fn path(&self) -> String {
        joined(self.section, self.name)
    }

    /// The matrix or list, whose numbers are finite.
    fn matrix(&self) -> Result<&Matrix, StorageError> {
        let FileEntry::Matrix(matrix) = self.entry else {
            return Err(StorageError::value(&self.path(), "is no matrix and no list of numbers"));
        };
        match matrix.data.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(StorageError::value(&self.path(), format!("number {i} is not finite"))),
            None => Ok(matrix),
        }
    }
}

/// A device: intrinsics in a section, and whose they are there.
#[derive(Clone, Debug, PartialEq)]
struct Device<'a> {
    section: &'a str,
    owner: EntryOwner,
    label: String,
}

/// Every entry whose name is known.
fn known(all: &Entries) -> Vec<NamedEntry<'_>> {
    let mut out = Vec::new();
    for (section, inside) in &all.sections {
        // A part of the picture that a driver was asked for.
        if section.rsplit('/').next() == Some("roi") {
            continue;
        }
        for (name, entry) in inside {
            let Some((owner, role, from_camera)) = meaning(name) else { continue };
            let digit = || EntryOwner::Other(name.chars().filter(char::is_ascii_digit).collect());
            let (owner, role) = match (entry, role) {
                // "K1" and "k1" may be the first device's matrices, or numbers of a lens.
                (FileEntry::Matrix(m), Role::Coefficient(_)) => match (m.rows, m.columns) {
                    (3, 3) => (digit(), Role::Intrinsics),
                    (3, 4) => (owner, Role::ByProduct),
                    _ => (digit(), Role::Distortion),
                },
                // A matrix F is fundamental, a number is not.
                (FileEntry::Number(_), Role::ByProduct) if name.len() == 1 => continue,
                (
                    FileEntry::Text(_),
                    Role::Intrinsics | Role::Distortion | Role::Rotation | Role::Translation,
                ) => continue,
                _ => (owner, role),
            };
            out.push(NamedEntry { section, name, owner, role, from_camera, entry });
        }
    }
    out
}

fn devices<'a>(known: &[NamedEntry<'a>]) -> Vec<Device<'a>> {
    let mut out: Vec<Device> = Vec::new();
    for k in known {
        let is_one = match k.role {
            Role::Intrinsics => matches!(k.entry, FileEntry::Matrix(_)),
            Role::Intrinsic(0) => matches!(k.entry, FileEntry::Number(_)),
            _ => false,
        };
        // Intrinsics in a section of their own belong to the section around it.
        let section = match k.section.rsplit_once('/') {
            Some((around, last)) if matches!(meaning(last), Some((_, Role::Intrinsics, _))) => around,
            None if matches!(meaning(k.section), Some((_, Role::Intrinsics, _))) => "",
            _ => k.section,
        };
        if !is_one || out.iter().any(|d| d.section == section && d.owner == k.owner) {
            continue;
        }
        let label = match (&k.owner, section) {
            (EntryOwner::Own, "") => k.name.to_owned(),
            (EntryOwner::Own, section) => section.to_owned(),
            (owner, section) => joined(section, owner.label()),
        };
        out.push(Device { section, owner: k.owner.clone(), label });
    }
    out
}

/// Blanks and case do not make another name.
fn same(a: &str, b: &str) -> bool {
    let plain = |s: &str| s.split_whitespace().collect::<Vec<_>>().join(" ").to_lowercase();
    plain(a) == plain(b)
}

fn says(label: &str, word: &str) -> bool {
    label.to_lowercase().contains(word)
}

/// The projector among the devices.
fn choose<'a>(
    all: &Entries,
    devices: &[Device<'a>],
    wanted: Option<&str>,
) -> Result<Device<'a>, StorageError> {
    let names = || devices.iter().take(16).map(|d| d.label.as_str()).collect::<Vec<_>>().join(", ");
    let ask = |count: usize| {
        StorageError::Refused(format!(
            "it has {count} devices ({}); name the projector's with projector.calibration_device",
            names()
        ))
    };
    if let Some(wanted) = wanted {
        let last = |d: &&Device| d.label.rsplit('/').next().is_some_and(|last| same(last, wanted));
        let hit = devices.iter().find(|d| same(&d.label, wanted)).or_else(|| devices.iter().find(last));
        return hit.cloned().ok_or_else(|| {
            StorageError::Refused(format!(
                "it has no device {wanted:?}, which projector.calibration_device names (it has: {})",
                names()
            ))
        });
    }
    let of = |owner: EntryOwner| devices.iter().filter(move |d| d.owner == owner);
    match devices {
        [] => Err(StorageError::Missing {
            part: "intrinsics",
            names: "camera_matrix, cameraMatrix, K, mtx, proj_int, proj_K, Kp, intrinsics, fx",
            has: all.matrices(),
        }),
        [only] if only.owner == EntryOwner::Camera => Err(StorageError::Refused(format!(
            "its only intrinsics are a camera's ({}), and the projector's are missing; if this is the projector, set \
             projector.calibration_device = {:?}",
            only.label, only.label
        ))),
        [only] => {
            let other = all.sections.keys().find(|s| says(s, "proj") && !only.section.starts_with(s.as_str()));
            match other.filter(|_| says(&only.label, "cam") && !only.section.is_empty()) {
                Some(section) => Err(StorageError::Refused(format!(
                    "its section {section:?} has no intrinsics (looked for camera_matrix, cameraMatrix, K, mtx, \
                     intrinsics, fx), and {:?} is another device; set projector.calibration_device to it if it is the \
                     projector",
                    only.label
                ))),
                None => Ok(only.clone()),
            }
        }
        [first, rest @ ..] => {
            let is_one_section = rest.iter().all(|d| d.section == first.section);
            let mut projectors = of(EntryOwner::Projector);
            match (projectors.next(), projectors.next()) {
                (Some(projector), None) if is_one_section => Ok(projector.clone()),
                _ => Err(ask(devices.len())),
            }
        }
    }
}

/// The parts of one device.
struct DeviceParts<'a, 'k> {
    device: &'k Device<'a>,
    /// Whether the section has the intrinsics of another device too, so that entries without an owner are of both.
    is_shared: bool,
    scope: Vec<&'k NamedEntry<'a>>,
}

impl<'a, 'k> DeviceParts<'a, 'k> {
    fn of(device: &'k Device<'a>, devices: &[Device], known: &'k [NamedEntry<'a>]) -> Self {
        let base = device.section;
        let inside = |section: &str, of: &str| {
            of.is_empty() || section.strip_prefix(of).is_some_and(|s| s.is_empty() || s.starts_with('/'))
        };
        let is_others = |section: &str| {
            let nearest = devices.iter().filter(|d| inside(section, d.section));
            nearest.max_by_key(|d| d.section.len()).is_some_and(|d| d.section != base)
        };
        let has_camera = devices.iter().any(|d| d.section == base && d.owner == EntryOwner::Camera);
        let is_mine = |k: &NamedEntry| {
            let is_owner = match &k.owner {
                EntryOwner::Own => true,
                // Beside one device without a name, "camera_rotation" is that of this device.
                EntryOwner::Camera if !has_camera && device.owner == EntryOwner::Own => true,
                owner => *owner == device.owner,
            };
            let is_here = inside(k.section, base) && !is_others(k.section);
            // What stands around the device's section is its own where it is of no other device.
            let is_around = inside(base, k.section) && k.section != base && !is_others(k.section)
                || k.section.is_empty() && devices.iter().all(|d| !d.section.is_empty());
            is_owner && (is_here || is_around)
        };
        let mut scope: Vec<&NamedEntry> = known.iter().filter(|k| is_mine(k)).collect();
        // The device's own words first, then those of its section, then those around it.
        scope.sort_by_key(|k| {
            (k.owner != device.owner, !inside(k.section, base), std::cmp::Reverse(k.section.len()))
        });
        let is_shared = devices.iter().any(|d| d.section == base && d.owner != device.owner);
        Self { device, is_shared, scope }
    }

    fn with(&self, role: Role) -> impl Iterator<Item = &'k NamedEntry<'a>> + '_ {
        self.scope.iter().copied().filter(move |k| k.role == role)
    }

    /// Entries of this role that are the device's by its name; of those without an owner only where no other device is in
    /// the section.
    fn own(&self, role: Role) -> impl Iterator<Item = &'k NamedEntry<'a>> + '_ {
        self.with(role).filter(|k| !self.is_shared || k.owner == self.device.owner)
    }

    fn number(&self, role: Role) -> Option<(&'k NamedEntry<'a>, f64)> {
        self.own(role).find_map(|k| match k.entry {
            FileEntry::Number(v) => Some((k, *v)),
            _ => None,
        })
    }
}

/// What was used of a file, for the messages.
#[derive(Default)]
struct UseNotes {
    paths: BTreeSet<String>,
    found: Vec<String>,
}

impl UseNotes {
    fn note(&mut self, part: &str, known: &NamedEntry) {
        self.paths.insert(known.path());
        self.found.push(format!("{part}: {}", known.path()));
    }
}

/// Two entries say the same thing differently.
fn contradiction(a: &NamedEntry, b: &NamedEntry, what: &str) -> StorageError {
    let problem = format!("and {:?} tell different {what}; leave the right one in the file", b.path());
    StorageError::value(&a.path(), problem)
}

fn intrinsics_of(k: &NamedEntry) -> Result<[f64; 4], StorageError> {
    let (m, name) = (k.matrix()?, k.path());
    let is_square = (m.rows, m.columns) == (3, 3) || (m.rows.min(m.columns) == 1 && m.data.len() == 9);
    if m.data.len() == 4 && m.rows.min(m.columns) == 1 {
        return Ok([m.data[0], m.data[1], m.data[2], m.data[3]]);
    }
    if !is_square {
        let what = format!("is {} x {}, not 3 x 3", m.rows, m.columns);
        return Err(StorageError::value(&name, what));
    }
    let d = &m.data;
    let (fx, skew, cx, fy, cy) = (d[0], d[1], d[2], d[4], d[5]);
    if (d[8] - 1.0).abs() > 1e-6 || d[3] != 0.0 || d[6] != 0.0 || d[7] != 0.0 {
        let mut what = "is not an upper triangular intrinsic matrix with 1 in its corner".to_owned();
        if cx == 0.0 && cy == 0.0 && (d[6] != 0.0 || d[7] != 0.0) {
            what += "; it is transposed, as MATLAB stores it: transpose it";
        }
        return Err(StorageError::value(&name, what));
    }
    if skew.abs() > 1e-3 * fx.abs() {
        return Err(StorageError::value(&name, format!("has skew {skew}: calibrate without it")));
    }
    Ok([fx, fy, cx, cy])
}

fn intrinsics(parts: &DeviceParts, used: &mut UseNotes) -> Result<(String, Intrinsics), StorageError> {
    let mut first: Option<(&NamedEntry, [f64; 4])> = None;
    for k in parts.own(Role::Intrinsics).filter(|k| matches!(k.entry, FileEntry::Matrix(_))) {
        let values = intrinsics_of(k)?;
        match &first {
            None => first = Some((k, values)),
            Some((other, told)) if told.iter().zip(values).any(|(a, b)| (a - b).abs() > 1e-6 * a.abs()) => {
                return Err(contradiction(other, k, "lenses"))
            }
            Some(_) => {}
        }
        used.note("intrinsics", k);
    }
    let numbers: Vec<_> = (0..4).filter_map(|i| parts.number(Role::Intrinsic(i))).collect();
    if let (None, [fx, fy, cx, cy]) = (&first, &numbers[..]) {
        numbers.iter().for_each(|(k, _)| used.note("intrinsics", k));
        first = Some((fx.0, [fx.1, fy.1, cx.1, cy.1]));
    }
    let Some((k, [fx, fy, cx, cy])) = first else {
        let names =
            "camera_matrix, cameraMatrix, K, mtx, proj_int, proj_K, Kp, intrinsics, or all of fx, fy, cx, cy";
        let has = numbers.iter().map(|(k, _)| k.path()).collect::<Vec<_>>().join(", ");
        return Err(StorageError::Missing { part: "intrinsics", names, has });
    };
    if ![fx, fy, cx, cy].iter().all(|v| v.is_finite()) {
        return Err(StorageError::value(&k.path(), "has a number that is not finite"));
    }
    // OpenCV puts pixel centres at whole numbers, this project at halves.
    Ok((k.path(), Intrinsics { fx, fy, cx: cx + 0.5, cy: cy + 0.5 }))
}

fn rotation_of(k: &NamedEntry) -> Result<DMat3, StorageError> {
    let (r, name) = (k.matrix()?, k.path());
    let matrix = match (r.rows, r.columns, r.data.len()) {
        (3, 3, _) | (1, 9, _) | (9, 1, _) => DMat3::from_cols_slice(&r.data).transpose(),
        (3, 1, _) | (1, 3, _) => {
            let vector = DVec3::from_slice(&r.data);
            if vector.length() > 2.0 * std::f64::consts::PI {
                let what = format!(
                    "turns by {:.1} rad, more than a whole turn: it is in degrees or holds Euler angles; give a rotation \
                     matrix, or a rotation vector in radians",
                    vector.length()
                );
                return Err(StorageError::value(&name, what));
            }
            DMat3::from_quat(dpm_common::so3::so3_exp(vector))
        }
        (rows, columns, _) => {
            let what = format!("is {rows} x {columns}, not 3 x 3 or a rotation vector");
            return Err(StorageError::value(&name, what));
        }
    };
    let what = "is not a rotation (columns must be orthonormal, determinant +1)";
    rotation(matrix).ok_or_else(|| StorageError::value(&name, what))
}

/// Rotation and translation of a matrix of four columns.
fn rigid(k: &NamedEntry) -> Result<(DMat3, DVec3), StorageError> {
    let (m, name) = (k.matrix()?, k.path());
    let wrong = |what: String| Err(StorageError::value(&name, what));
    let is_flat = m.rows.min(m.columns) == 1 && matches!(m.data.len(), 12 | 16);
    if !matches!((m.rows, m.columns), (4 | 3, 4)) && !is_flat {
        return wrong(format!("is {} x {}, not 4 x 4 or 3 x 4", m.rows, m.columns));
    }
    let d = &m.data;
    if d.len() == 16 && d[12..] != [0.0, 0.0, 0.0, 1.0] {
        let is_transposed = d[3] == 0.0 && d[7] == 0.0 && d[11] == 0.0 && d[15] == 1.0;
        let hint = if is_transposed { "; it is transposed: transpose it" } else { "" };
        return wrong(format!("has a last row other than 0 0 0 1{hint}"));
    }
    let turn = DMat3::from_cols_array(&[d[0], d[4], d[8], d[1], d[5], d[9], d[2], d[6], d[10]]);
    let Some(turn) = rotation(turn) else {
        return wrong("does not turn without scaling (its first three columns must be a rotation)".into());
    };
    Ok((turn, DVec3::new(d[3], d[7], d[11])))
}

/// A pose with the entries that tell it.
struct PoseEntries<'k, 'a> {
    rotation: DMat3,
    translation: DVec3,
    by: [&'k NamedEntry<'a>; 2],
}

fn told_pose<'k, 'a>(
    parts: &DeviceParts<'a, 'k>,
    used: &mut UseNotes,
) -> Result<Option<PoseEntries<'k, 'a>>, StorageError> {
    let mut told: Vec<PoseEntries> = Vec::new();
    for role in [Role::Pose, Role::Placement] {
        for k in parts.with(role).filter(|k| matches!(k.entry, FileEntry::Matrix(_))) {
            let (r, t) = rigid(k)?;
            let (rotation, translation) = match role {
                Role::Placement => (r.transpose(), -(r.transpose() * t)),
                _ => (r, t),
            };
            used.note("pose", k);
            told.push(PoseEntries { rotation, translation, by: [k, k] });
        }
    }
    let is_near = |a: DMat3, b: DMat3| (a - b).to_cols_array().iter().all(|v| v.abs() < 2e-3);
    let mut turn: Option<(&NamedEntry, DMat3)> = None;
    for k in parts.with(Role::Rotation).filter(|k| matches!(k.entry, FileEntry::Matrix(_))) {
        let r = rotation_of(k)?;
        if let Some((other, first)) = turn.filter(|(_, first)| !is_near(*first, r)) {
            // The device's own word counts before one without an owner.
            if other.owner != k.owner {
                continue;
            }
            let _ = first;
            return Err(contradiction(other, k, "rotations"));
        }
        used.note("rotation", k);
        turn = turn.or(Some((k, r)));
    }
    let mut shift: Option<(&NamedEntry, DVec3)> = None;
    for k in parts.with(Role::Translation).filter(|k| matches!(k.entry, FileEntry::Matrix(_))) {
        let t = k.matrix()?;
        if t.data.len() != 3 {
            return Err(StorageError::value(&k.path(), format!("has {} numbers, not 3", t.data.len())));
        }
        let t = DVec3::from_slice(&t.data);
        if let Some((other, _)) = shift.filter(|(_, s)| (*s - t).length() > 1e-3 * s.length()) {
            if other.owner != k.owner {
                continue;
            }
            return Err(contradiction(other, k, "translations"));
        }
        used.note("translation", k);
        shift = shift.or(Some((k, t)));
    }
    match (turn, shift, told.is_empty()) {
        (Some((a, rotation)), Some((b, translation)), _) => {
            told.push(PoseEntries { rotation, translation, by: [a, b] });
        }
        (Some(_), None, true) => return Err(missing(parts, "translation")),
        (None, Some(_), true) => return Err(missing(parts, "rotation")),
        _ => {}
    }
    let Some(first) = told.pop() else { return Ok(None) };
    for other in told {
        let apart = (first.translation - other.translation).length();
        if !is_near(first.rotation, other.rotation) || apart > 1e-3 * first.translation.length() {
            return Err(contradiction(first.by[0], other.by[0], "poses"));
        }
    }
    Ok(Some(first))
}

fn missing(parts: &DeviceParts, part: &'static str) -> StorageError {
    let names = match part {
        "translation" => "T, translation, translationVector, tvec, or a 4 x 4 matrix extrinsics",
        _ => "R, rotation, roration, rotationVector, rvec, or a 4 x 4 matrix extrinsics",
    };
    let matrices = parts.scope.iter().filter(|k| matches!(k.entry, FileEntry::Matrix(_)));
    let has: Vec<String> = matrices.take(24).map(|k| k.path()).collect();
    StorageError::Missing {
        part,
        names,
        has: if has.is_empty() { "no matrix".into() } else { has.join(", ") },
    }
}

/// Why there is no pose, with what to do.
fn no_pose(all: &Entries, parts: &DeviceParts) -> StorageError {
    let views = VIEWS.iter().find(|v| all.sections.values().any(|s| s.contains_key(**v)));
    if let Some(views) = views {
        let what = "holds the poses of a board in many views, and not the projector's in the world; add rvec and tvec, which \
                    take points of the world to the projector, for example from solvePnP";
        return StorageError::value(views, what);
    }
    if let Some(k) = parts.with(Role::EitherPose).next() {
        let what = "may take the world to the projector or the projector to the world, its name does not say which; name it \
                    \"extrinsics\" in the first case and \"camera_to_world\" in the second";
        return StorageError::value(&k.path(), what);
    }
    missing(parts, "rotation")
}

fn image_size(parts: &DeviceParts, used: &mut UseNotes) -> Result<Option<(u32, u32)>, StorageError> {
    let mut sizes: Vec<(&NamedEntry, f64, f64)> = Vec::new();
    if let (Some((k, w)), Some((l, h))) = (parts.number(Role::Width), parts.number(Role::Height)) {
        used.paths.extend([k.path(), l.path()]);
        sizes.push((k, w, h));
    }
    for role in [Role::Size, Role::Shape] {
        for k in parts.own(role) {
            let FileEntry::Matrix(m) = k.entry else { continue };
            let [a, b] = match m.data[..] {
                [a, b] | [a, b, _] => [a, b],
                _ => continue,
            };
            used.paths.insert(k.path());
            sizes.push(if role == Role::Size { (k, a, b) } else { (k, b, a) });
        }
    }
    let Some(&(first, width, height)) = sizes.first() else { return Ok(None) };
    if let Some((other, ..)) = sizes.iter().find(|(_, w, h)| (*w, *h) != (width, height)) {
        return Err(contradiction(first, other, "sizes of the raster"));
    }
    let side = |v: f64| {
        let known = (1.0..=f64::from(Raster::MAX_SIDE)).contains(&v) && v.fract() == 0.0;
        let what = || format!("is {width} x {height}, which is no size of a raster");
        known.then_some(v as u32).ok_or_else(|| StorageError::value(first.name, what()))
    };
    Ok(Some((side(width)?, side(height)?)))
}

/// What was not used: entries by their paths, and other devices by their names.
fn unread(
    all: &Entries,
    known: &[NamedEntry],
    devices: &[Device],
    parts: &DeviceParts,
    used: &UseNotes,
) -> Vec<String> {
    let chosen = parts.device;
    let is_others = |section: &str, owner: &EntryOwner| {
        let of = |d: &Device| {
            let is_in = section.strip_prefix(d.section).is_some_and(|s| s.is_empty() || s.starts_with('/'));
            d != chosen
                && (d.section != chosen.section && !d.section.is_empty() && is_in
                    || d.section == chosen.section && d.owner == *owner)
        };
        devices.iter().find(|d| of(d)).map(|d| d.label.clone())
    };
    let mut out: Vec<String> = Vec::new();
    let by_name: BTreeMap<(&str, &str), &NamedEntry> =
        known.iter().map(|k| ((k.section, k.name), k)).collect();
    for (section, inside) in &all.sections {
        for (name, entry) in inside {
            let path = joined(section, name);
            let hit = by_name.get(&(section.as_str(), name.as_str()));
            let owner = hit.map_or(EntryOwner::Own, |k| k.owner.clone());
            if let Some(label) = is_others(section, &owner) {
                let told = format!("the device {label}");
                if !out.contains(&told) {
                    out.push(told);
                }
                continue;
            }
            // Lists of texts name things and measure nothing.
            let is_known = hit.is_some_and(|k| k.role == Role::ByProduct)
                || VIEWS.contains(&name.as_str())
                || *entry == FileEntry::Other && section.is_empty();
            if !is_known && !used.paths.contains(&path) {
                out.push(path);
            }
        }
    }
    out.extend(all.repeated.iter().map(|path| format!("{path} (a second time)")));
    if out.len() > 32 {
        let more = out.len() - 32;
        out.truncate(32);
        out.push(format!("and {more} more"));
    }
    out
}

/// Whose frame the pose is told in.
fn frame(told: &PoseEntries, parts: &DeviceParts, devices: &[Device], known: &[NamedEntry]) -> PoseFrame {
    if let Some(k) = told.by.iter().find(|k| k.from_camera) {
        return PoseFrame::Camera { name: k.path() };
    }
    // Beside the intrinsics of another device a pose without an owner leads from that device to this one.
    let is_between = told.by.iter().all(|k| k.owner == EntryOwner::Own);
    let mut others = devices.iter().filter(|d| *d != parts.device);
    let other = others.clone().find(|d| d.section == parts.device.section || !is_within(told, parts));
    if let Some(other) = other.filter(|_| is_between && (parts.is_shared || !is_within(told, parts))) {
        let is_its = |k: &&NamedEntry| {
            k.section == other.section && k.owner == other.owner && k.role == Role::Intrinsics
        };
        let name = known.iter().find(is_its);
        return PoseFrame::Camera { name: name.map_or(other.label.clone(), NamedEntry::path) };
    }
    let is_origin = |d: &&Device| {
        let theirs = DeviceParts::of(d, devices, known);
        told_pose(&theirs, &mut UseNotes::default()).ok().flatten().is_some_and(|t| {
            t.translation == DVec3::ZERO
                && (t.rotation - DMat3::IDENTITY).to_cols_array().iter().all(|v| *v == 0.0)
        })
    };
    match others.find(is_origin) {
        Some(origin) => PoseFrame::WorldOfCamera { name: origin.label.clone() },
        None => PoseFrame::World,
    }
}

/// Whether the pose stands in the device's own section.
fn is_within(told: &PoseEntries, parts: &DeviceParts) -> bool {
    told.by.iter().all(|k| k.section.starts_with(parts.device.section) || parts.device.section.is_empty())
}

/// The pose of the device.
fn placed<'k, 'a>(
    all: &Entries,
    device: &Device,
    parts: &DeviceParts<'k, 'a>,
    used: &mut UseNotes,
) -> Result<PoseEntries<'k, 'a>, StorageError> {
    if matches!(&device.owner, EntryOwner::Other(label) if label == "1")
        && parts.own(Role::Rotation).next().is_none()
    {
        let shared = parts.with(Role::Rotation).next();
        if let Some(shared) = shared.filter(|_| parts.is_shared) {
            let what = "leads from device 1 to device 2, so device 1 has no pose in a world; calibrate so that the projector is \
                        the second device, or add its own rvec1 and tvec1";
            return Err(StorageError::value(&shared.path(), what));
        }
    }
    told_pose(parts, used)?.ok_or_else(|| no_pose(all, parts))
}

/// Reads a calibration. Rotation and translation take points of the calibration's world, or of its camera, into the
/// projector's space: `x_proj = R x + T`, looking along +Z with y down, as in OpenCV.
/// A file that is read for the lens alone needs neither.
pub(super) fn read(
    all: &Entries,
    options: &ReadOptions,
    purpose: Purpose,
) -> Result<StoredCalibration, StorageError> {
    let known = known(all);
    if known.len() > MOST_KNOWN {
        return Err(StorageError::Refused(format!("it has more than {MOST_KNOWN} entries of a calibration")));
    }
    let devices = devices(&known);
    if devices.len() > MOST_DEVICES {
        return Err(StorageError::Refused(format!(
            "it has {} devices, at most {MOST_DEVICES} are read",
            devices.len()
        )));
    }
    let device = choose(all, &devices, options.device)?;
    let parts = DeviceParts::of(&device, &devices, &known);
    let mut used = UseNotes::default();
    // Two models have an xi: the word for the model comes first.
    let fisheye = is_fisheye(&parts, options.lens, &mut used)?;
    check_mirror(&parts)?;
    let (k_name, k) = intrinsics(&parts, &mut used)?;
    let size = image_size(&parts, &mut used)?;
    let columns = size.map_or(options.raster.width(), |s| s.0);
    if k.fx > 0.0 && k.fx.min(k.fy) < LEAST_FOCAL * f64::from(columns) {
        let what = format!(
            "has focal lengths {} and {}, far below the {columns} columns of the raster: normalised coordinates? Multiply by \
             the raster's width and height",
            k.fx, k.fy
        );
        return Err(StorageError::value(&k_name, what));
    }
    let mut notes = Vec::new();
    let shift = k.cx / f64::from(columns) - 0.5;
    if size.is_none() && shift.abs() > RARE_SHIFT {
        notes.push(format!(
            "{k_name}: the file names no raster, and its principal point lies at column {:.0} of {columns}; if it was calibrated \
             at another resolution, set projector.calibration_raster",
            k.cx
        ));
    }
    let k_at = k.at(size, options.raster)?;
    let (place, frame) = match purpose {
        Purpose::Lens => (DAffine3::IDENTITY, PoseFrame::World),
        Purpose::Place => {
            let told = placed(all, &device, &parts, &mut used)?;
            let place = pose(told.rotation, told.translation * options.unit.metres());
            (place, frame(&told, &parts, &devices, &known))
        }
    };
    let lens = lens(&parts, fisheye, &mut used)?;
    check_unused_lens(all, &devices, &used)?;
    let camera =
        ProjectorCamera::new(options.raster, place, k_at.fx, k_at.fy, k_at.cx, k_at.cy)?.with_lens(lens)?;
    Ok(StoredCalibration {
        camera,
        frame,
        image_size: size,
        found: used.found.clone(),
        unread: unread(all, &known, &devices, &parts, &used),
        notes,
    })
}
