//! OBJ: vertices, texture coordinates, normals, and faces that refer to them line by line.

use super::document::{smooth_normals, Document, MaterialTriangles, Object};
use super::mtl::Library;
use super::ply::add_fan;
use super::{far, linear, lines, numbers};
use crate::limits::{Cancel, Limits};
use crate::SceneError;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// Number of a list's member that a corner does not name.
const NONE: u32 = u32::MAX;
/// Materials that faces may use: each costs some kilobytes.
const MOST_MATERIALS: u64 = 10_000;

/// A corner of a face: numbers of its position, texture coordinates and normal, or [`NONE`].
type Corner = [u32; 3];

/// The lists that faces refer to.
#[derive(Default)]
struct Lists {
    positions: Vec<[f64; 3]>,
    /// Colours after the positions; those before the first one that has a colour are white.
    colours: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    normals: Vec<[f32; 3]>,
}

/// Faces of one material in one object, as the file has them: what they name may stand behind them.
#[derive(Default)]
struct Faces {
    corners: Vec<Corner>,
    /// Number of corners of each face.
    sizes: Vec<u32>,
    is_smooth: bool,
}

/// What is left out of the faces, with how often.
#[derive(Default)]
struct Lost {
    faces: usize,
    uvs: usize,
    normals: usize,
}

impl Faces {
    /// The triangles of the faces whose vertices are there; `near` are the positions in single precision.
    fn into_part(self, lists: &Lists, near: &[[f32; 3]], lost: &mut Lost) -> MaterialTriangles {
        let mut part = MaterialTriangles::default();
        let mut known: HashMap<Corner, u32> = HashMap::new();
        let (mut has_uvs, mut has_normals) = (false, false);
        let mut rest = &self.corners[..];
        let mut fan = vec![];
        for size in self.sizes {
            let (face, after) = rest.split_at(size as usize);
            rest = after;
            if face.iter().any(|c| c[0] as usize >= near.len()) {
                lost.faces += 1;
                continue;
            }
            fan.clear();
            for &[position, uv, normal] in face {
                let (has_uv, has_normal) =
                    ((uv as usize) < lists.uvs.len(), (normal as usize) < lists.normals.len());
                lost.uvs += usize::from(uv != NONE && !has_uv);
                lost.normals += usize::from(normal != NONE && !has_normal);
                let corner =
                    [position, if has_uv { uv } else { NONE }, if has_normal { normal } else { NONE }];
                fan.push(*known.entry(corner).or_insert_with(|| {
                    part.positions.push(near[position as usize]);
                    if !lists.colours.is_empty() {
                        part.colours.push(lists.colours.get(position as usize).copied().unwrap_or([1.0; 3]));
                    }
                    part.uvs.push(if has_uv { lists.uvs[uv as usize] } else { [0.0; 2] });
                    // Zero is repaired by the reader of glTF.
                    part.normals.push(if has_normal { lists.normals[normal as usize] } else { [0.0; 3] });
                    part.positions.len() as u32 - 1
                }));
                (has_uvs, has_normals) = (has_uvs | has_uv, has_normals | has_normal);
            }
            add_fan(&fan, &mut part.triangles);
        }
        if !has_uvs {
            part.uvs.clear();
        }
        if !has_normals {
            part.normals =
                if self.is_smooth { smooth_normals(&part.positions, &part.triangles) } else { vec![] };
        }
        part
    }
}

/// Whether a file of no known ending is one: vertices and faces stand in it line by line.
pub(super) fn is_likely(bytes: &[u8]) -> bool {
    let begin = &bytes[..bytes.len().min(65_536)];
    let is_line = |line: &[u8]| {
        let line = line.trim_ascii_start();
        ["v ", "v\t", "vt ", "vn ", "f ", "mtllib ", "usemtl "].iter().any(|w| line.starts_with(w.as_bytes()))
    };
    let lines = begin.split(|b| matches!(b, b'\n' | b'\r'));
    let (mut known, mut other) = (0, 0);
    for line in
        lines.filter(|l| !l.trim_ascii().is_empty() && !l.trim_ascii_start().starts_with(b"#")).take(200)
    {
        *(if is_line(line) { &mut known } else { &mut other }) += 1;
    }
    known > 3 && known > 4 * other
}

/// What is read line by line.
struct ObjReader<'a> {
    lists: Lists,
    library: Library,
    /// The objects, and in each the faces by material; `None`: the file has named none.
    objects: Vec<(String, BTreeMap<Option<usize>, Faces>)>,
    /// Objects begin with `o`, in files that have none with `g`.
    begins: &'static str,
    material: Option<usize>,
    is_smooth: bool,
    triangles: u64,
    ignored: BTreeMap<&'static str, usize>,
    /// Colours that ZBrush writes into comments, for the vertices in their order.
    of_comments: Vec<[f32; 3]>,
    beside: Option<&'a Path>,
    limits: &'a Limits,
}

/// Reads a file, and the material files that it names.
pub(super) fn read(
    bytes: &[u8],
    name: &str,
    beside: Option<&Path>,
    limits: &Limits,
    cancel: &Cancel,
) -> Result<Document, SceneError> {
    if bytes.starts_with(&[0xfe, 0xff]) || bytes.starts_with(&[0xff, 0xfe]) {
        return Err(SceneError::unsupported("text in UTF-16", "save the file as UTF-8"));
    }
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let has_objects =
        bytes.split(|&b| matches!(b, b'\n' | b'\r')).any(|line| line.trim_ascii_start().starts_with(b"o "));
    let mut reader = ObjReader {
        lists: Lists::default(),
        library: Library::default(),
        objects: vec![(name.to_owned(), BTreeMap::new())],
        begins: if has_objects { "o" } else { "g" },
        material: None,
        is_smooth: false,
        triangles: 0,
        ignored: BTreeMap::new(),
        of_comments: vec![],
        beside,
        limits,
    };
    for (line, text) in lines(bytes) {
        if line % 65_536 == 0 {
            cancel.check(limits)?;
        }
        reader.line(line, &text)?;
    }
    reader.into_document()
}

impl ObjReader<'_> {
    fn line(&mut self, line: usize, text: &str) -> Result<(), SceneError> {
        if let Some(colours) = text.trim_start().strip_prefix("#MRGB") {
            return self.comment(colours);
        }
        let text = text.split('#').next().unwrap_or_default();
        let mut words = text.split_ascii_whitespace();
        let Some(word) = words.next() else { return Ok(()) };
        let rest = || text.trim_start()[word.len()..].trim();
        match word {
            "v" => self.vertex(line, &mut words),
            "vt" => {
                let mut number = || words.next().and_then(|w| w.parse().ok()).unwrap_or(0.0);
                // v points up here and down in glTF.
                self.lists.uvs.push([number(), 1.0 - number()]);
            }
            // Zero is repaired by the reader of glTF.
            "vn" => self
                .lists
                .normals
                .push(numbers::<3>(line, &mut words, "vn").map_or([0.0; 3], |n| n.map(|x| x as f32))),
            "f" | "fo" => self.face(&mut words)?,
            "o" | "g" if word == self.begins => self.begin(rest()),
            "usemtl" => self.material = Some(self.library.material(rest())),
            "mtllib" => self.library.add_files(rest(), self.beside, self.limits)?,
            "s" => self.is_smooth = !matches!(words.next(), None | Some("off" | "0")),
            "l" | "p" => *self.ignored.entry("points and lines").or_default() += 1,
            "vp" | "curv" | "curv2" | "surf" | "cstype" => {
                *self.ignored.entry("curves and surfaces").or_default() += 1;
            }
            "call" | "csh" | "ctech" | "stech" | "surf2" | "deg" | "bmat" | "hole" | "trim" => {
                *self.ignored.entry("curves and surfaces").or_default() += 1;
            }
            "g" | "o" | "mg" | "lod" | "bevel" | "c_interp" | "d_interp" | "shadow_obj" | "trace_obj"
            | "end" | "parm" | "con" | "sp" | "usemap" | "maplib" => {}
            _ => *self.ignored.entry("lines that begin with no word of the format").or_default() += 1,
        }
        Ok(())
    }

    /// Colours of ZBrush: for each vertex two digits of a mask and six of its colour.
    fn comment(&mut self, colours: &str) -> Result<(), SceneError> {
        for word in colours.trim().as_bytes().chunks_exact(8) {
            let word = std::str::from_utf8(word).ok().and_then(|w| u32::from_str_radix(w, 16).ok());
            let Some(word) = word else { break };
            let byte = |shift: u32| linear((word >> shift & 255) as f32 / 255.0);
            self.of_comments.push([byte(16), byte(8), byte(0)]);
        }
        Ok(())
    }

    fn begin(&mut self, name: &str) {
        match self.objects.last_mut() {
            // One that has no faces yet is renamed.
            Some((own, faces)) if faces.is_empty() => name.clone_into(own),
            _ => self.objects.push((name.to_owned(), BTreeMap::new())),
        }
    }

    fn vertex<'a>(&mut self, line: usize, words: &mut impl Iterator<Item = &'a str>) {
        // Faces count the vertices: one that is damaged keeps its number, and the reader of glTF leaves out what has it.
        let at = numbers(line, words, "v").unwrap_or_else(|_| {
            *self.ignored.entry("vertices that are no three numbers").or_default() += 1;
            [f64::NAN; 3]
        });
        self.lists.positions.push(at);
        let more: Vec<f32> = words.map_while(|w| w.parse().ok()).take(4).collect();
        // x y z r g b, or x y z w r g b; a fourth number alone is the weight of a curve.
        let colour = match more[..] {
            [r, g, b] => [r, g, b],
            [_, r, g, b] => [r, g, b],
            _ if self.lists.colours.is_empty() => return,
            _ => [1.0; 3],
        };
        self.lists.colours.resize(self.lists.positions.len() - 1, [1.0; 3]);
        self.lists.colours.push(colour.map(linear));
    }

    fn face<'a>(&mut self, words: &mut impl Iterator<Item = &'a str>) -> Result<(), SceneError> {
        let Some((_, faces)) = self.objects.last_mut() else { return Ok(()) };
        let faces = faces.entry(self.material).or_default();
        let begin = faces.corners.len();
        for word in words {
            let corner = corner(word, &self.lists);
            // A corner that is none damages its face, which is counted as the others are.
            faces.corners.push(corner.unwrap_or([NONE; 3]));
        }
        let size = faces.corners.len() - begin;
        if size < 3 {
            faces.corners.truncate(begin);
            *self.ignored.entry("faces of less than 3 corners").or_default() += 1;
            return Ok(());
        }
        self.triangles += size as u64 - 2;
        let limit = self.limits.triangles;
        SceneError::check_limit("the number of triangles", self.triangles, limit, "decimate the mesh")?;
        faces.is_smooth |= self.is_smooth;
        faces.sizes.push(size as u32);
        Ok(())
    }

    fn into_document(mut self) -> Result<Document, SceneError> {
        let white = self.objects.iter().any(|(_, faces)| faces.contains_key(&None));
        let white = white.then(|| self.library.white());
        if self.lists.colours.is_empty() && self.of_comments.len() >= self.lists.positions.len() {
            self.lists.colours = std::mem::take(&mut self.of_comments);
        }
        let (near, offset) = far::single(&self.lists.positions);
        let mut lost = Lost::default();
        let objects = self.objects.into_iter().map(|(name, faces)| {
            let parts = faces.into_iter().map(|(material, faces)| MaterialTriangles {
                material: material.or(white),
                ..faces.into_part(&self.lists, &near, &mut lost)
            });
            Object { name, parts: parts.collect() }
        });
        let has_triangles = |object: &Object| object.parts.iter().any(|part| !part.triangles.is_empty());
        let mut objects: Vec<Object> = objects.filter(has_triangles).collect();
        for (count, what) in [
            (lost.faces, "faces name vertices that are not there"),
            (lost.uvs, "corners name texture coordinates that are not there"),
            (lost.normals, "corners name normals that are not there"),
        ] {
            if count > 0 {
                self.library.told.push(format!("{count} {what}: they are left out"));
            }
        }
        if !self.of_comments.is_empty() {
            self.library.told.push("comments of ZBrush colour not all vertices: they are left out".into());
        }
        if objects.is_empty() {
            let why = match lost.faces {
                0 => "has no faces ('f'): is this an OBJ file of a mesh?".to_owned(),
                n => format!("has no face whose vertices are there: {n} name others"),
            };
            return Err(SceneError::broken("file", why));
        }
        let mut warnings = self.library.warnings();
        if !self.ignored.is_empty() {
            let all: Vec<String> =
                self.ignored.iter().map(|(what, times)| format!("{what} ({times} times)")).collect();
            warnings.push(format!("the file has what reflects no light: {}", all.join(", ")));
        }
        let materials = self.library.materials(&keep_used(&mut objects)?);
        Ok(Document { objects, materials, textures: self.library.uris, offset, warnings })
    }
}

/// The materials that parts use, by their numbers in the library; the parts name them by their places among these then.
fn keep_used(objects: &mut [Object]) -> Result<BTreeSet<usize>, SceneError> {
    let parts = || objects.iter().flat_map(|object| &object.parts);
    let used: BTreeSet<usize> = parts().filter_map(|part| part.material).collect();
    SceneError::check_limit(
        "the number of materials that faces use",
        used.len() as u64,
        MOST_MATERIALS,
        "merge materials",
    )?;
    let places: BTreeMap<usize, usize> =
        used.iter().enumerate().map(|(place, number)| (*number, place)).collect();
    for part in objects.iter_mut().flat_map(|object| &mut object.parts) {
        part.material = part.material.map(|number| places[&number]);
    }
    Ok(used)
}

/// `1`, `1/2`, `1//3` or `1/2/3`; numbers below zero count from the end of their list. `None` if it is none of these. What it
/// names may still come.
fn corner(word: &str, lists: &Lists) -> Option<Corner> {
    let index = |part: &str, length: usize| -> Option<u32> {
        let number: i64 = part.parse().ok()?;
        let index = if number < 0 { length as i64 + number } else { number - 1 };
        u32::try_from(index).ok().filter(|i| *i != NONE)
    };
    let mut parts = word.split('/');
    let position = index(parts.next().unwrap_or_default(), lists.positions.len())?;
    // A number that is none names nothing, and is counted with those that are not there.
    let mut other = |length: usize| match parts.next().filter(|part| !part.is_empty()) {
        Some(part) => index(part, length).unwrap_or(NONE - 1),
        None => NONE,
    };
    Some([position, other(lists.uvs.len()), other(lists.normals.len())])
}
