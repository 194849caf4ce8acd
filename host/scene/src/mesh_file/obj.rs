//! OBJ: vertices, texture coordinates, normals, and faces that refer to them line by line.

use super::document::{smooth_normals, Document, Object, Part};
use super::mtl::Library;
use super::ply::add_fan;
use super::{linear, lines, numbers};
use crate::limits::{Cancel, Limits};
use crate::SceneError;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// A corner of a face: position, and texture coordinates and normal if it names them.
type Corner = (u32, Option<u32>, Option<u32>);

/// The lists that faces refer to.
#[derive(Default)]
struct Lists {
    positions: Vec<[f32; 3]>,
    /// Colours after the positions; those before the first one that has a colour are white.
    colours: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    normals: Vec<[f32; 3]>,
}

/// Faces of one material in one object.
#[derive(Default)]
struct Faces {
    part: Part,
    known: HashMap<Corner, u32>,
    has_uvs: bool,
    has_normals: bool,
    is_smooth: bool,
}

impl Faces {
    fn corner(&mut self, lists: &Lists, corner: Corner) -> u32 {
        if let Some(&known) = self.known.get(&corner) {
            return known;
        }
        let (position, uv, normal) = corner;
        let part = &mut self.part;
        part.positions.push(lists.positions[position as usize]);
        if let Some(colour) = lists.colours.get(position as usize) {
            part.colours.push(*colour);
        }
        part.uvs.push(uv.map_or([0.0; 2], |i| lists.uvs[i as usize]));
        // Zero is repaired by the reader of glTF.
        part.normals.push(normal.map_or([0.0; 3], |i| lists.normals[i as usize]));
        self.has_uvs |= uv.is_some();
        self.has_normals |= normal.is_some();
        let number = part.positions.len() as u32 - 1;
        self.known.insert(corner, number);
        number
    }

    fn into_part(self) -> Part {
        let Self { mut part, has_uvs, has_normals, is_smooth, .. } = self;
        if !has_uvs {
            part.uvs.clear();
        }
        if !has_normals {
            part.normals = if is_smooth { smooth_normals(&part.positions, &part.triangles) } else { vec![] };
        }
        // Corners before the first coloured vertex have none.
        if part.colours.len() < part.positions.len() {
            part.colours.clear();
        }
        part
    }
}

/// What is read line by line.
struct Reader<'a> {
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
    let has_objects = bytes.split(|&b| b == b'\n').any(|line| line.trim_ascii_start().starts_with(b"o "));
    let mut reader = Reader {
        lists: Lists::default(),
        library: Library::default(),
        objects: vec![(name.to_owned(), BTreeMap::new())],
        begins: if has_objects { "o" } else { "g" },
        material: None,
        is_smooth: false,
        triangles: 0,
        ignored: BTreeMap::new(),
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

impl Reader<'_> {
    fn line(&mut self, line: usize, text: &str) -> Result<(), SceneError> {
        let text = text.split('#').next().unwrap_or_default();
        let mut words = text.split_ascii_whitespace();
        let Some(word) = words.next() else { return Ok(()) };
        let rest = || text.trim_start()[word.len()..].trim();
        match word {
            "v" => self.vertex(line, &mut words)?,
            "vt" => {
                let [u] = numbers::<1>(line, &mut words, "vt")?;
                let v = words.next().and_then(|w| w.parse().ok()).unwrap_or(0.0);
                // v points up here and down in glTF.
                self.lists.uvs.push([u, 1.0 - v]);
            }
            "vn" => self.lists.normals.push(numbers(line, &mut words, "vn")?),
            "f" | "fo" => self.face(line, &mut words)?,
            "o" | "g" if word == self.begins => self.begin(rest()),
            "usemtl" => self.material = Some(self.library.material(rest())),
            "mtllib" => self.library.add_file(rest(), self.beside, self.limits)?,
            "s" => self.is_smooth = !matches!(words.next(), None | Some("off" | "0")),
            "l" | "p" => *self.ignored.entry("points and lines").or_default() += 1,
            "vp" | "curv" | "curv2" | "surf" | "cstype" => {
                *self.ignored.entry("curves and surfaces").or_default() += 1;
            }
            _ => {}
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

    fn vertex<'a>(
        &mut self,
        line: usize,
        words: &mut impl Iterator<Item = &'a str>,
    ) -> Result<(), SceneError> {
        self.lists.positions.push(numbers(line, words, "v")?);
        let more: Vec<f32> = words.map_while(|w| w.parse().ok()).take(4).collect();
        // x y z r g b, or x y z w r g b; a fourth number alone is the weight of a curve.
        let colour = match more[..] {
            [r, g, b] => [r, g, b],
            [_, r, g, b] => [r, g, b],
            _ if self.lists.colours.is_empty() => return Ok(()),
            _ => [1.0; 3],
        };
        self.lists.colours.resize(self.lists.positions.len() - 1, [1.0; 3]);
        self.lists.colours.push(colour.map(linear));
        Ok(())
    }

    fn face<'a>(&mut self, line: usize, words: &mut impl Iterator<Item = &'a str>) -> Result<(), SceneError> {
        let corners: Vec<Corner> =
            words.map(|word| corner(line, word, &self.lists)).collect::<Result<_, _>>()?;
        if corners.len() < 3 {
            *self.ignored.entry("faces of less than 3 corners").or_default() += 1;
            return Ok(());
        }
        self.triangles += corners.len() as u64 - 2;
        let limit = self.limits.triangles;
        SceneError::check_limit("the number of triangles", self.triangles, limit, "decimate the mesh")?;
        let Some((_, faces)) = self.objects.last_mut() else { return Ok(()) };
        let faces = faces.entry(self.material).or_default();
        faces.is_smooth |= self.is_smooth;
        let corners: Vec<u32> = corners.into_iter().map(|corner| faces.corner(&self.lists, corner)).collect();
        add_fan(&corners, &mut faces.part.triangles);
        Ok(())
    }

    fn into_document(mut self) -> Result<Document, SceneError> {
        let white = self.objects.iter().any(|(_, faces)| faces.contains_key(&None));
        let white = white.then(|| self.library.material("white"));
        let objects = self.objects.into_iter().map(|(name, faces)| {
            let parts = faces
                .into_iter()
                .map(|(material, faces)| Part { material: material.or(white), ..faces.into_part() });
            Object { name, parts: parts.collect() }
        });
        let objects: Vec<Object> = objects.filter(|object| !object.parts.is_empty()).collect();
        if objects.is_empty() {
            return Err(SceneError::broken("file", "has no faces ('f'): is this an OBJ file of a mesh?"));
        }
        let mut warnings = self.library.warnings();
        if !self.ignored.is_empty() {
            let all: Vec<String> =
                self.ignored.iter().map(|(what, times)| format!("{what} ({times} times)")).collect();
            warnings.push(format!("the file has what reflects no light: {}", all.join(", ")));
        }
        Ok(Document { objects, materials: self.library.materials(), textures: self.library.uris, warnings })
    }
}

/// `1`, `1/2`, `1//3` or `1/2/3`; numbers below zero count from the end of their list.
fn corner(line: usize, word: &str, lists: &Lists) -> Result<Corner, SceneError> {
    let wrong = |problem: String| SceneError::broken(format!("line {line}"), problem);
    let index = |part: &str, length: usize, what: &str| -> Result<u32, SceneError> {
        let number: i64 = part
            .parse()
            .map_err(|_| wrong(format!("has the corner '{}', which is none", super::shortened(word))))?;
        let index = if number < 0 { length as i64 + number } else { number - 1 };
        u32::try_from(index)
            .ok()
            .filter(|&i| (i as usize) < length)
            .ok_or_else(|| wrong(format!("names {what} {number}, but there are {length} before it")))
    };
    let mut parts = word.split('/');
    let position = index(parts.next().unwrap_or_default(), lists.positions.len(), "vertex")?;
    let uv = parts.next().filter(|part| !part.is_empty());
    let normal = parts.next().filter(|part| !part.is_empty());
    let uv = uv.map(|part| index(part, lists.uvs.len(), "texture coordinate")).transpose()?;
    let normal = normal.map(|part| index(part, lists.normals.len(), "normal")).transpose()?;
    Ok((position, uv, normal))
}
