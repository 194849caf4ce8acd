//! The lens of a device: which model its file names, and the coefficients in OpenCV's order.

use super::super::entries::{joined, Entries, FileEntry};
use super::super::foreign::{model, refused_model, OMNIDIRECTIONAL};
use super::super::names::{meaning, plain, Role};
use super::super::{LensKind, StorageError};
use super::{contradiction, Device, DeviceParts, NamedEntry, UseNotes};
use dpm_scene::geometry::lens::Lens;

/// Whether a coefficient of the lens is other than 0.
fn bends(parts: &DeviceParts) -> bool {
    let of = |k: &NamedEntry| matches!(k.entry, FileEntry::Matrix(m) if m.data.iter().any(|v| *v != 0.0));
    parts.own(Role::Distortion).any(of)
}

/// Refuses a lens that needs more than OpenCV's models have.
pub(super) fn check_mirror(parts: &DeviceParts) -> Result<(), StorageError> {
    for k in parts.own(Role::Mirror) {
        let xi = match k.entry {
            FileEntry::Number(xi) => *xi,
            FileEntry::Matrix(m) => m.data.first().copied().unwrap_or(0.0),
            _ => 0.0,
        };
        if xi != 0.0 {
            return Err(refused_model(&k.path(), &xi.to_string(), OMNIDIRECTIONAL));
        }
    }
    match parts.own(Role::Other).next() {
        None => Ok(()),
        Some(k) => {
            let what = "is of MATLAB, whose pixels count from 1 and whose rotation is transposed; save what \
                        cameraIntrinsicsToOpenCV gives as K, dist and ImageSize [columns, rows], with R and T";
            Err(StorageError::value(&k.path(), what))
        }
    }
}

/// Whether the file says that its lens is a fisheye's; `None` if it says nothing.
fn says_fisheye(parts: &DeviceParts, used: &mut UseNotes) -> Result<Option<(String, bool)>, StorageError> {
    let mut said: Option<(String, bool)> = None;
    for k in parts.with(Role::LensModel) {
        let name = plain(k.name);
        // The word alone may as well name the device.
        let is_vague = name == "model";
        let is_model = matches!(&*name, "cameramodel" | "cameratype" | "modeltype" | "model");
        let of_realsense = |code: f64| {
            const NAMES: [&str; 6] = [
                "none",
                "modified brown conrady",
                "inverse brown conrady",
                "ftheta",
                "brown conrady",
                "fisheye",
            ];
            NAMES.get(code as usize).filter(|_| code >= 0.0).map(|word| word.to_string())
        };
        let word = match k.entry {
            FileEntry::Number(code) if is_vague => of_realsense(*code),
            FileEntry::Text(word) => Some(word.to_ascii_lowercase().replace("distortion.", "")),
            _ => None,
        };
        let lens = word.as_deref().and_then(|word| Some((word, model(word)?)));
        if let Some((word, what)) = lens {
            return Err(refused_model(&k.path(), word, what));
        }
        let fisheye = match (k.entry, word.as_deref()) {
            (FileEntry::Number(flag), None) if !is_vague => Some(*flag != 0.0),
            (_, Some(word)) => match word {
                "fisheye" | "equidistant" | "equi" | "kannala_brandt" | "kannalabrandt8" | "kannala brandt4" | "kb4"
                | "true" => Some(true),
                "pinhole" | "pinhole_full" if is_model => None,
                "plumb_bob" | "rational_polynomial" | "radtan" | "brown" | "opencv" | "none" | "" | "false"
                | "pinhole" | "brown-conrady" | "brown_conrady" | "brown conrady" | "rational"
                | "radial-tangential" => Some(false),
                "modified brown conrady" | "inverse brown conrady" | "modified_brown_conrady"
                | "inverse_brown_conrady" => {
                    if bends(parts) {
                        return Err(refused_model(&k.path(), word, "RealSense's inverse or modified model of Brown"));
                    }
                    Some(false)
                }
                _ if is_vague => continue,
                _ => {
                    return Err(StorageError::value(
                        &k.path(),
                        format!(
                            "is {word:?}; known are plumb_bob, radtan, rational_polynomial, fisheye and equidistant; calibrate \
                             with one of these"
                        ),
                    ))
                }
            },
            _ => None,
        };
        if !is_vague || fisheye.is_some() {
            used.paths.insert(k.path());
        }
        said = said.or(fisheye.map(|f| (k.path(), f)));
    }
    Ok(said)
}

/// Refuses a file with one device and with a section of a lens of which nothing is understood.
pub(super) fn check_unused_lens(
    all: &Entries,
    devices: &[Device],
    used: &UseNotes,
) -> Result<(), StorageError> {
    let is_lens = |section: &str| {
        let last = section.rsplit('/').next().unwrap_or_default();
        !section.is_empty() && matches!(meaning(last), Some((_, Role::Distortion, _)))
    };
    let sections = all.sections.iter().filter(|(section, _)| devices.len() == 1 && is_lens(section));
    for (section, inside) in sections {
        let is_used = inside.keys().any(|name| used.paths.contains(&joined(section, name)));
        let bends = |entry: &FileEntry| match entry {
            FileEntry::Number(v) => *v != 0.0,
            FileEntry::Matrix(m) => m.data.iter().any(|v| *v != 0.0),
            _ => false,
        };
        if let Some((name, _)) = inside.iter().find(|(_, entry)| !is_used && bends(entry)) {
            let what = "is of a lens and is not understood; give the coefficients k1, k2, p1, p2, k3 in this order as dist";
            return Err(StorageError::value(&joined(section, name), what));
        }
    }
    Ok(())
}

/// Whether the lens is a fisheye's, by the rig file and by the file itself.
pub(super) fn is_fisheye(
    parts: &DeviceParts,
    kind: LensKind,
    used: &mut UseNotes,
) -> Result<bool, StorageError> {
    Ok(match (kind, says_fisheye(parts, used)?) {
        (LensKind::Fisheye, Some((name, false))) => {
            let what =
                "says that the lens is no fisheye, but the rig file says calibration_lens = \"fisheye\"";
            return Err(StorageError::value(&name, what));
        }
        (LensKind::Fisheye, _) => true,
        (LensKind::Auto, said) => said.is_some_and(|(_, fisheye)| fisheye),
    })
}

/// The lens, by the coefficients in OpenCV's order.
pub(super) fn lens(parts: &DeviceParts, fisheye: bool, used: &mut UseNotes) -> Result<Lens, StorageError> {
    let mut first: Option<(String, Vec<f64>)> = None;
    let mut from: Option<&NamedEntry> = None;
    for k in parts.own(Role::Distortion) {
        let data = match k.entry {
            FileEntry::Number(_) => continue,
            _ => &k.matrix()?.data,
        };
        match (&first, from) {
            (Some((_, told)), Some(other)) if told != data && !data.is_empty() => {
                return Err(contradiction(other, k, "distortions"))
            }
            _ => first = Some((k.path(), data.clone())),
        }
        from = Some(k);
        used.note("distortion", k);
    }
    let numbers: Vec<_> = (0..8).filter_map(|i| Some((i, parts.number(Role::Coefficient(i))?))).collect();
    if let (None, Some((_, (k, _)))) = (&first, numbers.first()) {
        let mut data = vec![0.0; if numbers.iter().any(|(i, _)| *i > 4) { 8 } else { 5 }];
        numbers.iter().for_each(|(i, (_, v))| data[*i] = *v);
        numbers.iter().for_each(|(_, (k, _))| used.note("distortion", k));
        if fisheye {
            // Its coefficients are k1 to k4, or k2 to k5 in CamOdoCal.
            let is_shifted = numbers.iter().all(|(i, _)| *i > 0) && numbers.iter().any(|(i, _)| *i == 6);
            let places = if is_shifted { [1, 4, 5, 6] } else { [0, 1, 4, 5] };
            data = places.map(|i| data.get(i).copied().unwrap_or(0.0)).to_vec();
        }
        first = Some((k.path(), data));
    }
    let Some((name, d)) = first.filter(|(_, d)| !d.is_empty()) else {
        // An equidistant lens without coefficients still bends; OpenCV writes its four zeros.
        return match fisheye {
            false => Ok(Lens::default()),
            true => Lens::fisheye([0.0; 4]).map_err(|e| StorageError::lens("fisheye_model", e)),
        };
    };
    if !fisheye {
        return Lens::opencv(&d).map_err(|e| StorageError::lens(&name, e));
    }
    match d.as_slice().try_into() {
        Ok(k) => Lens::fisheye(k).map_err(|e| StorageError::lens(&name, e)),
        Err(_) => {
            let what = format!("has {} numbers, but a fisheye lens has 4", d.len());
            Err(StorageError::value(&name, what))
        }
    }
}
