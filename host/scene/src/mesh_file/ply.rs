//! PLY: a header that declares elements and their properties, then their values as text or as bytes of either order.

use super::document::{smooth_normals, Document, MaterialTriangles, Object};
use super::{far, linear, mtl, uri_of};
use crate::limits::{Cancel, Limits};
use crate::SceneError;
use serde_json::json;
use std::path::Path;

/// Elements and properties of a header beyond which it counts as damage.
const MAX_ELEMENTS: usize = 64;
const MAX_PROPERTIES: usize = 256;
const MAX_TEXTURES: usize = 256;
/// Corners of one face beyond which it counts as damage.
const MAX_CORNERS: usize = 65_536;

#[derive(Clone, Copy, Debug, PartialEq)]
enum PlyForm {
    Text,
    Little,
    Big,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum NumberKind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl NumberKind {
    fn of(word: &str) -> Option<Self> {
        Some(match word {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value that stands for full light in a colour of this kind.
    fn full(self) -> f32 {
        match self {
            Self::I8 | Self::U8 => 255.0,
            Self::I16 | Self::U16 => 65_535.0,
            _ => 1.0,
        }
    }
}

struct Property {
    name: String,
    /// Kind of the count, if it is a list.
    count: Option<NumberKind>,
    kind: NumberKind,
}

struct PlyElement {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

struct Header {
    form: PlyForm,
    elements: Vec<PlyElement>,
    textures: Vec<String>,
}

fn broken(problem: impl Into<String>) -> SceneError {
    SceneError::broken("PLY header", problem)
}

/// The header, and the bytes after it.
fn read_header(bytes: &[u8]) -> Result<(Header, &[u8]), SceneError> {
    let mut header = Header { form: PlyForm::Text, elements: vec![], textures: vec![] };
    let mut has_form = false;
    let mut rest = bytes;
    for number in 1.. {
        let end = rest.iter().take(4096).position(|&b| b == b'\n' || b == b'\r');
        let end = end.ok_or_else(|| broken("has no 'end_header': it is cut off"))?;
        let line = String::from_utf8_lossy(&rest[..end]).into_owned();
        // The byte after a carriage return belongs to the line's end only if it is a line feed.
        let both = rest[end..].starts_with(b"\r\n");
        rest = &rest[end + 1 + usize::from(both)..];
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["end_header", ..] if has_form => return Ok((header, rest)),
            ["format", form, ..] => {
                has_form = true;
                header.form = match form {
                    "ascii" => PlyForm::Text,
                    "binary_little_endian" => PlyForm::Little,
                    "binary_big_endian" => PlyForm::Big,
                    other => return Err(broken(format!("names the format '{other}', which is none of PLY"))),
                };
            }
            ["comment", "TextureFile", ..] if header.textures.len() < MAX_TEXTURES => {
                header.textures.push(words[2..].join(" "));
            }
            ["element" | "property", ..] => declare(&words, &mut header.elements).ok_or_else(|| {
                broken(format!("line {number} is no declaration: {}", super::shortened(&line)))
            })?,
            // Comments, also those whose writer forgot to mark them.
            _ => {}
        }
    }
    Err(broken("has no end"))
}

/// Adds what a line declares; `None` if it is wrong.
fn declare(words: &[&str], elements: &mut Vec<PlyElement>) -> Option<()> {
    match *words {
        ["element", name, count] if elements.len() < MAX_ELEMENTS => {
            elements.push(PlyElement {
                name: name.to_owned(),
                count: count.parse().ok()?,
                properties: vec![],
            });
        }
        ["property", "list", count, kind, name] => {
            let count =
                NumberKind::of(count).filter(|kind| !matches!(kind, NumberKind::F32 | NumberKind::F64))?;
            let list = Property { name: name.to_owned(), count: Some(count), kind: NumberKind::of(kind)? };
            elements.last_mut().filter(|e| e.properties.len() < MAX_PROPERTIES)?.properties.push(list);
        }
        ["property", kind, name] => {
            let plain = Property { name: name.to_owned(), count: None, kind: NumberKind::of(kind)? };
            elements.last_mut().filter(|e| e.properties.len() < MAX_PROPERTIES)?.properties.push(plain);
        }
        _ => return None,
    }
    Some(())
}

/// The values after the header, one after the other.
struct Values<'a> {
    form: PlyForm,
    rest: &'a [u8],
    /// Lines of a text that hold more than their element.
    too_long: usize,
}

impl Values<'_> {
    /// The next value; `None` at the end of the file, or if a text is no number.
    fn next(&mut self, kind: NumberKind) -> Option<f64> {
        if self.form == PlyForm::Text {
            let begin = self.rest.iter().position(|b| !b.is_ascii_whitespace())?;
            let word = &self.rest[begin..];
            let end = word.iter().position(u8::is_ascii_whitespace).unwrap_or(word.len());
            self.rest = &word[end..];
            return std::str::from_utf8(&word[..end]).ok()?.parse().ok();
        }
        let size = kind.bytes();
        let mut raw = [0; 8];
        raw[..size].copy_from_slice(self.rest.get(..size)?);
        self.rest = &self.rest[size..];
        if self.form == PlyForm::Big {
            raw[..size].reverse();
        }
        let [a, b, c, d, ..] = raw;
        Some(match kind {
            NumberKind::I8 => f64::from(a as i8),
            NumberKind::U8 => f64::from(a),
            NumberKind::I16 => f64::from(i16::from_le_bytes([a, b])),
            NumberKind::U16 => f64::from(u16::from_le_bytes([a, b])),
            NumberKind::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            NumberKind::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            NumberKind::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            NumberKind::F64 => f64::from_le_bytes(raw),
        })
    }

    /// Leaves out what a text has behind an element in its line: an element has a line of its own, and what is more than the header
    /// declares is no part of the next one.
    fn end_line(&mut self) {
        if self.form != PlyForm::Text {
            return;
        }
        let end = self.rest.iter().position(|b| matches!(b, b'\n' | b'\r')).unwrap_or(self.rest.len());
        self.too_long += usize::from(self.rest[..end].iter().any(|b| !b.is_ascii_whitespace()));
        self.rest = &self.rest[end..];
    }

    /// One element; `lists` get the members of its lists, one for each property.
    fn element(&mut self, element: &PlyElement, row: &mut Vec<f64>, lists: &mut [Vec<f64>]) -> Option<()> {
        row.clear();
        for (property, list) in element.properties.iter().zip(lists) {
            list.clear();
            let Some(count) = property.count else {
                row.push(self.next(property.kind)?);
                continue;
            };
            row.push(0.0);
            let count = self.next(count).filter(|n| *n >= 0.0)?;
            for _ in 0..count as u64 {
                list.push(self.next(property.kind)?);
            }
        }
        Some(())
    }

    /// How many of an element the rest of the file can hold at most.
    fn room(&self, element: &PlyElement) -> usize {
        let size = |p: &Property| match (self.form, p.count) {
            // A digit, and a blank before the next one.
            (PlyForm::Text, _) => 2,
            (_, Some(count)) => count.bytes(),
            (_, None) => p.kind.bytes(),
        };
        let each = element.properties.iter().map(size).sum::<usize>().max(1);
        (self.rest.len() + 1) / each
    }
}

/// The vertices of a file.
#[derive(Default)]
struct Vertices {
    positions: Vec<[f64; 3]>,
    normals: Vec<[f32; 3]>,
    uvs: Vec<[f32; 2]>,
    colours: Vec<[f32; 3]>,
}

/// The faces of a file as triangles, before it is known which vertices there are.
#[derive(Default)]
struct Faces {
    /// Numbers of vertices.
    triangles: Vec<[u32; 3]>,
    /// Linear colour of each triangle, if faces have colours.
    colours: Vec<[f32; 3]>,
    /// Texture coordinates of each triangle's corners, if faces have them.
    uvs: Vec<[[f32; 2]; 3]>,
    /// Texture of each triangle, if the file has several.
    textures: Vec<u32>,
    /// Faces whose corners are no numbers of vertices.
    damaged: usize,
}

impl Faces {
    /// Leaves out the triangles with a corner that is none of `count` vertices. Returns their number.
    fn leave_out_without(&mut self, count: usize) -> usize {
        let has_all = |t: &[u32; 3]| t.iter().all(|i| (*i as usize) < count);
        let is_there: Vec<bool> = self.triangles.iter().map(has_all).collect();
        let lost = is_there.iter().filter(|there| !**there).count();
        if lost > 0 {
            keep(&mut self.triangles, &is_there);
            keep(&mut self.colours, &is_there);
            keep(&mut self.uvs, &is_there);
            keep(&mut self.textures, &is_there);
        }
        lost
    }
}

fn keep<T>(list: &mut Vec<T>, is_there: &[bool]) {
    let mut is_there = is_there.iter();
    list.retain(|_| *is_there.next().unwrap_or(&false));
}

/// Number of a corner that is none: no file has so many vertices.
const NO_VERTEX: u32 = u32::MAX;

/// Reads a file as one object.
pub(super) fn read(
    bytes: &[u8],
    name: &str,
    beside: Option<&Path>,
    limits: &Limits,
    cancel: &Cancel,
) -> Result<Document, SceneError> {
    let (header, rest) = read_header(bytes)?;
    let mut values = Values { form: header.form, rest, too_long: 0 };
    let (mut vertices, mut faces, mut document) =
        (Vertices::default(), Faces::default(), Document::default());
    let mut unused: Vec<String> = vec![];
    for element in header.elements.iter().filter(|element| !element.properties.is_empty()) {
        let mut reader = ElementReader {
            element,
            limits,
            cancel,
            values: &mut values,
            used: vec![false; element.properties.len()],
        };
        let read = match element.name.as_str() {
            "vertex" => reader.vertices(&mut vertices)?,
            "face" | "tristrips" => reader.faces(&mut faces)?,
            _ => reader.each(|_, _| Ok(()))?,
        };
        let of_element = element.properties.iter().zip(&reader.used);
        let names = of_element.filter(|(p, used)| !**used && p.name != "alpha");
        unused.extend(names.map(|(p, _)| format!("{} {}", element.name, p.name)));
        if read < element.count {
            document.warnings.push(format!(
                "the file is cut off or damaged: {} of {} elements '{}' are left out, and what follows them",
                element.count - read,
                element.count,
                super::shortened(&element.name)
            ));
            break;
        }
    }
    if values.too_long > 0 {
        let lines = values.too_long;
        document
            .warnings
            .push(format!("{lines} lines hold more than the header declares: the rest of them is ignored"));
    }
    if !unused.is_empty() {
        unused.truncate(12);
        document
            .warnings
            .push(format!("properties that reflect no light are not used: {}", unused.join(", ")));
    }
    let parts = parts(vertices, faces, &header.textures, (beside, limits), &mut document)?;
    document.objects.push(Object { name: name.to_owned(), parts });
    Ok(document)
}

/// The surfaces, each with one material.
fn parts(
    mut vertices: Vertices,
    mut faces: Faces,
    textures: &[String],
    (beside, limits): (Option<&Path>, &Limits),
    document: &mut Document,
) -> Result<Vec<MaterialTriangles>, SceneError> {
    let count = vertices.positions.len();
    let lost = faces.leave_out_without(count);
    if faces.triangles.is_empty() {
        return Err(without_faces(count, lost + faces.damaged, &document.warnings));
    }
    if lost + faces.damaged > 0 {
        let told =
            format!("{} faces name vertices that are not there: they are left out", lost + faces.damaged);
        document.warnings.push(told);
    }
    let (near, offset) = far::single(&vertices.positions);
    vertices.positions = vec![];
    document.offset = offset;
    let has_normals = !vertices.normals.is_empty();
    let mut part = MaterialTriangles {
        normals: if has_normals { vertices.normals } else { smooth_normals(&near, &faces.triangles) },
        positions: near,
        uvs: vertices.uvs,
        colours: vertices.colours,
        ..MaterialTriangles::default()
    };
    say_of_corners(&mut part, &mut faces);
    let numbers = materials(textures, part.uvs.is_empty(), (beside, limits), document);
    let plain = document.materials.len();
    let of = |texture: u32| numbers.get(texture as usize).copied().flatten().unwrap_or(plain);
    let several = faces.textures.iter().any(|t| *t != 0) && numbers.len() > 1;
    let mut all: Vec<(usize, Vec<[u32; 3]>)> = vec![];
    if several {
        let mut by_material = std::collections::BTreeMap::<usize, Vec<[u32; 3]>>::new();
        for (triangle, texture) in faces.triangles.iter().zip(&faces.textures) {
            by_material.entry(of(*texture)).or_default().push(*triangle);
        }
        all.extend(by_material);
    } else {
        all.push((of(0), faces.triangles));
    }
    document.materials.push(mtl::plain("PLY"));
    let last = all.len() - 1;
    let own = |(i, (material, triangles)): (usize, (usize, Vec<[u32; 3]>))| {
        // The last one has all vertices: the reader of glTF keeps those that its triangles name.
        let (whole, triangles) = match i == last {
            true => (std::mem::take(&mut part), triangles),
            false => (compact(&part, &triangles), of_own_corners(triangles.len())),
        };
        MaterialTriangles { material: Some(material), triangles, ..whole }
    };
    Ok(all.into_iter().enumerate().map(own).collect())
}

/// Why a file without a face that can be shown is refused: of `count` vertices, `named` faces name others.
fn without_faces(count: usize, named: usize, warnings: &[String]) -> SceneError {
    let why = match (count, named) {
        (0, 0) => "is empty: it has no vertices and no faces".into(),
        (_, 0) => "has no faces: a cloud of points reflects no light, make a mesh of it".into(),
        (_, n) => {
            format!("has no face whose vertices are there ({n} name others, of {count}): it is cut off")
        }
    };
    let noted = warnings.join("; ");
    let noted = if noted.is_empty() { noted } else { format!(" ({noted})") };
    SceneError::broken("file", format!("{why}{noted}"))
}

/// Triangles that share no corner, each with the next three.
fn of_own_corners(count: usize) -> Vec<[u32; 3]> {
    (0..count as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect()
}

/// What faces have of their own is said of each corner.
fn say_of_corners(part: &mut MaterialTriangles, faces: &mut Faces) {
    if faces.colours.is_empty() && faces.uvs.is_empty() {
        return;
    }
    let corners = faces.triangles.as_flattened();
    let apart = |list: &[[f32; 3]]| corners.iter().filter_map(|i| list.get(*i as usize).copied()).collect();
    part.positions = apart(&part.positions);
    part.normals = apart(&part.normals);
    part.colours = match faces.colours.is_empty() {
        true => apart(&part.colours),
        false => faces.colours.iter().flat_map(|c| [*c; 3]).collect(),
    };
    part.uvs = match faces.uvs.is_empty() {
        true => corners.iter().filter_map(|i| part.uvs.get(*i as usize).copied()).collect(),
        false => faces.uvs.as_flattened().to_vec(),
    };
    faces.triangles = of_own_corners(faces.triangles.len());
}

/// The material of each texture in `document`; `None` where its picture cannot be shown, which is told.
fn materials(
    textures: &[String],
    is_without_coordinates: bool,
    (beside, limits): (Option<&Path>, &Limits),
    document: &mut Document,
) -> Vec<Option<usize>> {
    let mut material = |texture: &String| {
        let uri = uri_of(texture);
        let made = match mtl::picture(&uri, beside, limits) {
            _ if is_without_coordinates => Err("no vertex and no face has texture coordinates".into()),
            Ok(()) => Ok(uri),
            Err(why) => Err(why),
        };
        match made {
            Ok(uri) => {
                let look =
                    json!({"baseColorTexture": {"index": document.textures.len()}, "metallicFactor": 0.0});
                document.textures.push(uri);
                document
                    .materials
                    .push(json!({"name": texture, "doubleSided": true, "pbrMetallicRoughness": look}));
                Some(document.materials.len() - 1)
            }
            Err(why) => {
                document.warnings.push(format!("the texture '{texture}' is left out: {why}"));
                None
            }
        }
    };
    textures.iter().map(&mut material).collect()
}

/// The corners of some triangles of a part, one after the other.
fn compact(part: &MaterialTriangles, triangles: &[[u32; 3]]) -> MaterialTriangles {
    let corners = triangles.as_flattened();
    let apart = |list: &[[f32; 3]]| corners.iter().filter_map(|i| list.get(*i as usize).copied()).collect();
    MaterialTriangles {
        positions: apart(&part.positions),
        normals: apart(&part.normals),
        colours: apart(&part.colours),
        uvs: corners.iter().filter_map(|i| part.uvs.get(*i as usize).copied()).collect(),
        ..MaterialTriangles::default()
    }
}

struct ElementReader<'a, 'b> {
    element: &'a PlyElement,
    limits: &'a Limits,
    cancel: &'a Cancel,
    values: &'a mut Values<'b>,
    /// Which properties are of use.
    used: Vec<bool>,
}

impl ElementReader<'_, '_> {
    /// Calls `take` with the values and the lists of every element; gives how many are there.
    fn each(
        &mut self,
        mut take: impl FnMut(&[f64], &[Vec<f64>]) -> Result<(), SceneError>,
    ) -> Result<usize, SceneError> {
        let mut row = vec![];
        let mut lists = vec![vec![]; self.element.properties.len()];
        for i in 0..self.element.count {
            if i % 65_536 == 0 {
                self.cancel.check(self.limits)?;
            }
            if self.values.element(self.element, &mut row, &mut lists).is_none() {
                return Ok(i);
            }
            self.values.end_line();
            take(&row, &lists)?;
        }
        Ok(self.element.count)
    }

    /// The first of the properties that has one of these names.
    fn find(&mut self, names: &[&str], is_list: bool) -> Option<usize> {
        let is_it = |p: &Property| names.contains(&p.name.as_str()) && p.count.is_some() == is_list;
        let found = self.element.properties.iter().position(is_it)?;
        self.used[found] = true;
        Some(found)
    }

    fn all<const N: usize>(&mut self, names: [&[&str]; N]) -> Option<[usize; N]> {
        let found: Vec<usize> = names.iter().filter_map(|names| self.find(names, false)).collect();
        found.try_into().ok()
    }

    /// The properties of a colour, and what stands for full light in each.
    fn colour(&mut self) -> Option<([usize; 3], [f32; 3])> {
        let colour = self.all([
            &["red", "r", "diffuse_red"],
            &["green", "g", "diffuse_green"],
            &["blue", "b", "diffuse_blue"],
        ])?;
        Some((colour, colour.map(|i| self.element.properties[i].kind.full())))
    }

    fn vertices(&mut self, vertices: &mut Vertices) -> Result<usize, SceneError> {
        let at =
            self.all([&["x"], &["y"], &["z"]]).ok_or_else(|| broken("has vertices without x, y and z"))?;
        let normal = self.all([&["nx"], &["ny"], &["nz"]]);
        let uv = self.all([&["u", "s", "texture_u"], &["v", "t", "texture_v"]]);
        let colour = self.colour();
        let pick = |row: &[f64], i: usize| row[i] as f32;
        vertices.positions.reserve(self.element.count.min(self.values.room(self.element)));
        self.each(|row, _| {
            vertices.positions.push(at.map(|i| row[i]));
            vertices.normals.extend(normal.map(|n| n.map(|i| pick(row, i))));
            // The first row of the picture is the highest v.
            vertices.uvs.extend(uv.map(|[u, v]| [pick(row, u), 1.0 - pick(row, v)]));
            vertices
                .colours
                .extend(colour.map(|(c, full)| [0, 1, 2].map(|k| linear(pick(row, c[k]) / full[k]))));
            Ok(())
        })
    }

    fn faces(&mut self, faces: &mut Faces) -> Result<usize, SceneError> {
        let Some(indices) = self.find(&["vertex_indices", "vertex_index"], true) else {
            return self.each(|_, _| Ok(()));
        };
        let is_strip = self.element.name == "tristrips";
        let colour = self.colour();
        let uvs = if is_strip { None } else { self.find(&["texcoord"], true) };
        let texture = self.find(&["texnumber"], false);
        let limit = self.limits.triangles;
        let mut corners = vec![];
        let number = |i: f64| if (0.0..f64::from(NO_VERTEX)).contains(&i) { i as u32 } else { NO_VERTEX };
        self.each(|row, lists| {
            let list = &lists[indices];
            let before = faces.triangles.len();
            if is_strip {
                list.split(|&i| i < 0.0).for_each(|strip| add_strip(strip, &mut faces.triangles));
            } else if list.len() > MAX_CORNERS {
                faces.damaged += 1;
            } else {
                corners.clear();
                corners.extend(list.iter().map(|i| number(*i)));
                add_fan(&corners, &mut faces.triangles);
            }
            let made = faces.triangles.len() - before;
            if let Some((c, full)) = colour {
                let colour = [0, 1, 2].map(|k| linear(row[c[k]] as f32 / full[k]));
                faces.colours.extend(std::iter::repeat_n(colour, made));
            }
            if let Some(uvs) = uvs {
                let uv = |corner: usize| {
                    let at = |k: usize| lists[uvs].get(2 * corner + k).copied().unwrap_or(0.0) as f32;
                    // The first row of the picture is the highest v.
                    [at(0), 1.0 - at(1)]
                };
                faces.uvs.extend((0..made).map(|t| [uv(0), uv(t + 1), uv(t + 2)]));
            }
            if let Some(texture) = texture {
                faces.textures.extend(std::iter::repeat_n(number(row[texture]), made));
            }
            SceneError::check_limit(
                "the number of triangles",
                faces.triangles.len() as u64,
                limit,
                "decimate the mesh",
            )
        })
    }
}

/// A convex polygon as triangles.
pub(super) fn add_fan(corners: &[u32], triangles: &mut Vec<[u32; 3]>) {
    triangles
        .extend(corners.get(1..).unwrap_or_default().windows(2).map(|pair| [corners[0], pair[0], pair[1]]));
}

fn add_strip(strip: &[f64], triangles: &mut Vec<[u32; 3]>) {
    triangles.extend(strip.windows(3).enumerate().map(|(i, c)| {
        let number = |i: f64| if i < f64::from(NO_VERTEX) { i as u32 } else { NO_VERTEX };
        let [a, b, c] = [number(c[0]), number(c[1]), number(c[2])];
        if i % 2 == 0 {
            [a, b, c]
        } else {
            [b, a, c]
        }
    }));
}
