//! PLY: a header that declares elements and their properties, then their values as text or as bytes of either order.

use super::document::{smooth_normals, Document, Object, Part};
use super::{linear, mtl, uri_of};
use crate::limits::{Cancel, Limits};
use crate::SceneError;
use serde_json::json;
use std::path::Path;

/// Elements and properties of a header beyond which it counts as damage.
const MAX_ELEMENTS: usize = 64;
const MAX_PROPERTIES: usize = 256;
/// Corners of one face beyond which it counts as damage.
const MAX_CORNERS: usize = 65_536;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    Text,
    Little,
    Big,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Kind {
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
    count: Option<Kind>,
    kind: Kind,
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

struct Header {
    form: Form,
    elements: Vec<Element>,
    texture: Option<String>,
}

fn broken(problem: impl Into<String>) -> SceneError {
    SceneError::broken("PLY header", problem)
}

/// The header, and the bytes after it.
fn read_header(bytes: &[u8]) -> Result<(Header, &[u8]), SceneError> {
    let mut header = Header { form: Form::Text, elements: vec![], texture: None };
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
            ["end_header"] if has_form => return Ok((header, rest)),
            ["format", form, _] => {
                has_form = true;
                header.form = match form {
                    "ascii" => Form::Text,
                    "binary_little_endian" => Form::Little,
                    "binary_big_endian" => Form::Big,
                    other => return Err(broken(format!("names the format '{other}', which is none of PLY"))),
                };
            }
            ["comment", "TextureFile", ..] => header.texture = Some(words[2..].join(" ")),
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
fn declare(words: &[&str], elements: &mut Vec<Element>) -> Option<()> {
    match *words {
        ["element", name, count] if elements.len() < MAX_ELEMENTS => {
            elements.push(Element { name: name.to_owned(), count: count.parse().ok()?, properties: vec![] });
        }
        ["property", "list", count, kind, name] => {
            let count = Kind::of(count).filter(|kind| !matches!(kind, Kind::F32 | Kind::F64))?;
            let list = Property { name: name.to_owned(), count: Some(count), kind: Kind::of(kind)? };
            elements.last_mut().filter(|e| e.properties.len() < MAX_PROPERTIES)?.properties.push(list);
        }
        ["property", kind, name] => {
            let plain = Property { name: name.to_owned(), count: None, kind: Kind::of(kind)? };
            elements.last_mut().filter(|e| e.properties.len() < MAX_PROPERTIES)?.properties.push(plain);
        }
        _ => return None,
    }
    Some(())
}

/// The values after the header, one after the other.
struct Values<'a> {
    form: Form,
    rest: &'a [u8],
    /// Lines of a text that hold more than their element.
    too_long: usize,
}

impl Values<'_> {
    /// The next value; `None` at the end of the file, or if a text is no number.
    fn next(&mut self, kind: Kind) -> Option<f64> {
        if self.form == Form::Text {
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
        if self.form == Form::Big {
            raw[..size].reverse();
        }
        let [a, b, c, d, ..] = raw;
        Some(match kind {
            Kind::I8 => f64::from(a as i8),
            Kind::U8 => f64::from(a),
            Kind::I16 => f64::from(i16::from_le_bytes([a, b])),
            Kind::U16 => f64::from(u16::from_le_bytes([a, b])),
            Kind::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Kind::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Kind::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Kind::F64 => f64::from_le_bytes(raw),
        })
    }

    /// Leaves out what a text has behind an element in its line: an element has a line of its own, and what is more than the header
    /// declares is no part of the next one.
    fn end_line(&mut self) {
        if self.form != Form::Text {
            return;
        }
        let end = self.rest.iter().position(|b| matches!(b, b'\n' | b'\r')).unwrap_or(self.rest.len());
        self.too_long += usize::from(self.rest[..end].iter().any(|b| !b.is_ascii_whitespace()));
        self.rest = &self.rest[end..];
    }

    /// One element; lists are given to `list` with the number of their property.
    fn element(
        &mut self,
        element: &Element,
        row: &mut Vec<f64>,
        list: &mut Vec<f64>,
        wanted: Option<usize>,
    ) -> Option<()> {
        row.clear();
        list.clear();
        for (i, property) in element.properties.iter().enumerate() {
            let Some(count) = property.count else {
                row.push(self.next(property.kind)?);
                continue;
            };
            row.push(0.0);
            let count = self.next(count).filter(|n| *n >= 0.0)?;
            for _ in 0..count as u64 {
                let value = self.next(property.kind)?;
                if wanted == Some(i) {
                    list.push(value);
                }
            }
        }
        Some(())
    }

    /// An error unless the rest of the file can hold all of an element.
    fn check_room(&self, element: &Element) -> Result<(), SceneError> {
        let size = |p: &Property| match (self.form, p.count) {
            // A digit, and a blank before the next one.
            (Form::Text, _) => 2,
            (_, Some(count)) => count.bytes(),
            (_, None) => p.kind.bytes(),
        };
        let needed = element.properties.iter().map(size).sum::<usize>().saturating_mul(element.count);
        if needed > self.rest.len() + 1 {
            return Err(broken(format!(
                "promises {} elements '{}', for which {} bytes are not enough: the file is cut off",
                element.count,
                element.name,
                self.rest.len()
            )));
        }
        Ok(())
    }
}

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
    let (mut part, mut document) = (Part::default(), Document::default());
    let mut corners_of_texture = 0;
    for element in header.elements.iter().filter(|element| !element.properties.is_empty()) {
        values.check_room(element)?;
        let mut reader = Reader { element, limits, cancel, values: &mut values };
        match element.name.as_str() {
            "vertex" => reader.vertices(&mut part)?,
            "face" | "tristrips" => {
                corners_of_texture += usize::from(element.properties.iter().any(|p| p.name == "texcoord"));
                reader.faces(&mut part)?;
            }
            _ => reader.each(None, |_, _, _| Ok(()))?,
        }
    }
    if part.triangles.is_empty() {
        let why = if part.positions.is_empty() {
            "is empty: it has no vertices and no faces"
        } else {
            "has no faces: a cloud of points reflects no light, make a mesh of it"
        };
        return Err(SceneError::broken("file", why));
    }
    if part.normals.is_empty() {
        part.normals = smooth_normals(&part.positions, &part.triangles);
    }
    if values.too_long > 0 {
        let lines = values.too_long;
        document
            .warnings
            .push(format!("{lines} lines hold more than the header declares: the rest of them is ignored"));
    }
    if corners_of_texture > 0 {
        document.warnings.push("texture coordinates of faces are ignored: save them for vertices".into());
    }
    if let Some(texture) = header.texture.filter(|_| !part.uvs.is_empty()) {
        let uri = uri_of(&texture);
        match mtl::picture(&uri, beside, limits) {
            Ok(()) => {
                let look = json!({"baseColorTexture": {"index": 0}, "metallicFactor": 0.0});
                document.textures.push(uri);
                document.materials.push(json!({"name": texture, "pbrMetallicRoughness": look}));
                (part.material, part.colours) = (Some(0), vec![]);
            }
            Err(why) => document.warnings.push(format!("the texture '{texture}' is left out: {why}")),
        }
    }
    if part.material.is_none() {
        document.materials.push(mtl::plain("PLY"));
        part.material = Some(0);
    }
    document.objects.push(Object { name: name.to_owned(), parts: vec![part] });
    Ok(document)
}

struct Reader<'a, 'b> {
    element: &'a Element,
    limits: &'a Limits,
    cancel: &'a Cancel,
    values: &'a mut Values<'b>,
}

impl Reader<'_, '_> {
    /// Calls `take` with the number, the values and the wanted list of every element.
    fn each(
        &mut self,
        wanted: Option<usize>,
        mut take: impl FnMut(usize, &[f64], &[f64]) -> Result<(), SceneError>,
    ) -> Result<(), SceneError> {
        let (mut row, mut list) = (vec![], vec![]);
        for i in 0..self.element.count {
            if i % 65_536 == 0 {
                self.cancel.check(self.limits)?;
            }
            let read = self.values.element(self.element, &mut row, &mut list, wanted);
            read.ok_or_else(|| {
                let what = format!("{} {i} of {}", self.element.name, self.element.count);
                SceneError::broken(what, "is cut off, or holds what is no number")
            })?;
            self.values.end_line();
            take(i, &row, &list)?;
        }
        Ok(())
    }

    /// The first of the properties that has one of these names.
    fn find(&self, names: &[&str]) -> Option<usize> {
        self.element.properties.iter().position(|p| names.contains(&p.name.as_str()))
    }

    fn all<const N: usize>(&self, names: [&[&str]; N]) -> Option<[usize; N]> {
        let found: Vec<usize> = names.iter().filter_map(|names| self.find(names)).collect();
        found.try_into().ok()
    }

    fn vertices(&mut self, part: &mut Part) -> Result<(), SceneError> {
        let at =
            self.all([&["x"], &["y"], &["z"]]).ok_or_else(|| broken("has vertices without x, y and z"))?;
        let normal = self.all([&["nx"], &["ny"], &["nz"]]);
        let uv = self.all([&["u", "s", "texture_u"], &["v", "t", "texture_v"]]);
        let colour = self.all([
            &["red", "r", "diffuse_red"],
            &["green", "g", "diffuse_green"],
            &["blue", "b", "diffuse_blue"],
        ]);
        let full = colour.map(|c| c.map(|i| self.element.properties[i].kind.full()));
        let pick = |row: &[f64], i: usize| row[i] as f32;
        self.each(None, |_, row, _| {
            part.positions.push(at.map(|i| pick(row, i)));
            part.normals.extend(normal.map(|n| n.map(|i| pick(row, i))));
            // The first row of the picture is the highest v.
            part.uvs.extend(uv.map(|[u, v]| [pick(row, u), 1.0 - pick(row, v)]));
            part.colours.extend(
                colour.zip(full).map(|(c, full)| [0, 1, 2].map(|k| linear(pick(row, c[k]) / full[k]))),
            );
            Ok(())
        })
    }

    fn faces(&mut self, part: &mut Part) -> Result<(), SceneError> {
        let Some(indices) = self.find(&["vertex_indices", "vertex_index"]) else {
            return self.each(None, |_, _, _| Ok(()));
        };
        let is_strip = self.element.name == "tristrips";
        let (vertices, limit) = (part.positions.len(), self.limits.triangles);
        let mut corners = vec![];
        self.each(Some(indices), |face, _, list| {
            let strip_ends = |i: f64| is_strip && i < 0.0;
            if let Some(wrong) = list.iter().find(|&&i| !(strip_ends(i) || i >= 0.0 && i < vertices as f64)) {
                return Err(SceneError::broken(
                    format!("face {face}"),
                    format!("names vertex {wrong} of {vertices}"),
                ));
            }
            if !is_strip && list.len() > MAX_CORNERS {
                return Err(SceneError::broken(
                    format!("face {face}"),
                    format!("has {} corners", list.len()),
                ));
            }
            if is_strip {
                list.split(|&i| i < 0.0).for_each(|strip| add_strip(strip, &mut part.triangles));
            } else {
                corners.clear();
                corners.extend(list.iter().map(|&i| i as u32));
                add_fan(&corners, &mut part.triangles);
            }
            SceneError::check_limit(
                "the number of triangles",
                part.triangles.len() as u64,
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
        let [a, b, c] = [c[0] as u32, c[1] as u32, c[2] as u32];
        if i % 2 == 0 {
            [a, b, c]
        } else {
            [b, a, c]
        }
    }));
}
