//! MTL: the materials of an OBJ file as materials of glTF.

use super::{linear, lines, numbers, uri_of};
use crate::gltf_file;
use crate::limits::Limits;
use crate::SceneError;
use serde_json::{json, Value};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// Names that a message shows.
const SHOWN: usize = 8;
/// Files of materials, and pictures, that are looked for: each name costs a look into a folder.
const MOST_FILES: usize = 4096;

/// A matt material of full albedo on both sides.
pub(super) fn plain(name: &str) -> Value {
    json!({
        "name": name, "doubleSided": true, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    })
}

/// `Ok` if the picture that a URI names can be read; else why not.
pub(super) fn picture(uri: &str, beside: Option<&Path>, limits: &Limits) -> Result<(), String> {
    let bytes = gltf_file::fetch_beside(uri, beside, limits.bytes).map_err(|e| e.to_string())?;
    gltf_file::check_image(&bytes, uri, limits).map_err(|e| e.to_string())
}

/// What a statement of a material may say.
#[derive(Clone, Debug)]
struct MtlStatement {
    name: String,
    diffuse: [f32; 3],
    emissive: [f32; 3],
    specular: [f32; 3],
    /// Phong's exponent.
    exponent: Option<f32>,
    roughness: Option<f32>,
    metallic: f32,
    /// Colour texture, by its number.
    map: Option<usize>,
    emissive_map: Option<usize>,
    normal_map: Option<usize>,
}

impl MtlStatement {
    fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            diffuse: [1.0; 3],
            emissive: [0.0; 3],
            specular: [0.0; 3],
            exponent: None,
            roughness: None,
            metallic: 0.0,
            map: None,
            emissive_map: None,
            normal_map: None,
        }
    }

    fn to_gltf(&self) -> Value {
        // Many writers leave the colour black beside a texture.
        let colour =
            if self.map.is_some() && self.diffuse == [0.0; 3] { [1.0; 3] } else { self.diffuse.map(linear) };
        // The width of Phong's lobe as that of Beckmann's and GGX's.
        let shines = self.specular.iter().any(|s| *s > 0.0);
        let phong = self.exponent.filter(|_| shines).map(|n| (2.0 / (n.max(0.0) + 2.0)).powf(0.25));
        let roughness = self.roughness.or(phong).unwrap_or(1.0).clamp(0.0, 1.0);
        let [r, g, b] = colour;
        let mut pbr = json!({"baseColorFactor": [r, g, b, 1.0], "metallicFactor": self.metallic.clamp(0.0, 1.0), "roughnessFactor": roughness});
        let texture = |index: usize| json!({"index": index});
        if let Some(map) = self.map {
            pbr["baseColorTexture"] = texture(map);
        }
        let mut material = json!({"name": self.name, "pbrMetallicRoughness": pbr, "doubleSided": true});
        let emits = self.emissive.map(|e| e.max(0.0));
        if let Some(map) = self.emissive_map {
            material["emissiveTexture"] = texture(map);
            material["emissiveFactor"] = json!(if emits == [0.0; 3] { [1.0; 3] } else { emits });
        } else {
            material["emissiveFactor"] = json!(emits);
        }
        if let Some(map) = self.normal_map {
            material["normalTexture"] = texture(map);
        }
        material
    }
}

/// The materials that an OBJ file names.
#[derive(Default)]
pub(super) struct Library {
    looks: Vec<MtlStatement>,
    numbers: BTreeMap<String, usize>,
    /// Names without capitals, with the only name that has these letters; `None` if there are several.
    alike: HashMap<String, Option<String>>,
    /// Names of files that were looked for.
    files: BTreeSet<String>,
    /// URIs of pictures with their numbers; `None` for those that cannot be read.
    pictures: BTreeMap<String, Option<usize>>,
    /// URIs in the order of their numbers.
    pub uris: Vec<String>,
    /// Statements that are not reproduced, with how often they occur.
    ignored: BTreeMap<&'static str, usize>,
    /// Files that cannot be read, and why.
    missing: Vec<String>,
    /// Names of materials that no file has declared before.
    undeclared: BTreeSet<String>,
    /// More for the operator.
    pub told: Vec<String>,
}

impl Library {
    /// Reads the files that `names` gives, which may be one name with blanks or several names, beside the OBJ file. One that
    /// cannot be read is noted: its materials are white.
    pub(super) fn add_files(
        &mut self,
        names: &str,
        beside: Option<&Path>,
        limits: &Limits,
    ) -> Result<(), SceneError> {
        let fetch = |name: &str| gltf_file::fetch_beside(&uri_of(name), beside, limits.json_bytes);
        if !self.is_new(names)? {
            return Ok(());
        }
        let several: Vec<&str> = names.split_ascii_whitespace().collect();
        let whole = fetch(names);
        if several.len() < 2 || whole.is_ok() {
            return self.add_file(names, whole, beside, limits);
        }
        for name in several.into_iter().take(64) {
            if self.is_new(name)? {
                self.add_file(name, fetch(name), beside, limits)?;
            }
        }
        Ok(())
    }

    /// Whether a file of materials was not looked for before.
    fn is_new(&mut self, name: &str) -> Result<bool, SceneError> {
        let is_new = self.files.insert(name.to_owned());
        let (count, most) = (self.files.len() as u64, MOST_FILES as u64);
        SceneError::check_limit("the number of files of materials", count, most, "name one file")?;
        Ok(is_new)
    }

    fn add_file(
        &mut self,
        name: &str,
        content: Result<Vec<u8>, SceneError>,
        beside: Option<&Path>,
        limits: &Limits,
    ) -> Result<(), SceneError> {
        match content {
            Ok(bytes) => {
                let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
                self.add(bytes, beside, limits).map_err(|e| SceneError::broken(name, e.to_string()))
            }
            Err(e) => {
                self.missing.push(format!("{name} ({e})"));
                Ok(())
            }
        }
    }

    /// Number of the material of a name; a name that no file has declared is white. Where no file has its letters, one that
    /// has them in another case is meant.
    pub(super) fn material(&mut self, name: &str) -> usize {
        if let Some(&number) = self.numbers.get(name) {
            return number;
        }
        if let Some(Some(near)) = self.alike.get(&name.to_lowercase()) {
            return self.numbers[near];
        }
        self.undeclared.insert(name.to_owned());
        self.declare(name)
    }

    /// Number of the material of faces that name none.
    pub(super) fn white(&mut self) -> usize {
        self.declare("white")
    }

    fn declare(&mut self, name: &str) -> usize {
        self.looks.push(MtlStatement::new(name));
        let number = self.looks.len() - 1;
        self.numbers.insert(name.to_owned(), number);
        let only = self.alike.entry(name.to_lowercase()).or_insert_with(|| Some(name.to_owned()));
        if only.as_deref() != Some(name) {
            *only = None;
        }
        number
    }

    fn add(&mut self, bytes: &[u8], beside: Option<&Path>, limits: &Limits) -> Result<(), SceneError> {
        let mut current = None;
        for (line, text) in lines(bytes) {
            let mut words = text.split_ascii_whitespace();
            let Some(word) = words.next() else { continue };
            let rest = text.trim_start()[word.len()..].trim();
            if word == "newmtl" {
                // One that the mesh has named before is described now.
                current = Some(match self.numbers.get(rest) {
                    Some(&known) if self.undeclared.remove(rest) => known,
                    _ => self.declare(rest),
                });
                SceneError::check_limit(
                    "the number of materials",
                    self.looks.len() as u64,
                    limits.objects,
                    "merge materials",
                )?;
                continue;
            }
            // Without a material before it a statement has no meaning.
            let Some(number) = current else { continue };
            if word.starts_with("map_") || matches!(word, "bump" | "norm" | "disp" | "decal" | "refl") {
                self.texture(number, word, rest, beside, limits);
            } else {
                let is_read = self.statement(number, word, line, words).is_ok();
                if !is_read {
                    *self.ignored.entry("statements without their numbers").or_default() += 1;
                }
            }
        }
        Ok(())
    }

    fn statement<'a>(
        &mut self,
        number: usize,
        word: &str,
        line: usize,
        mut words: impl Iterator<Item = &'a str>,
    ) -> Result<(), SceneError> {
        let look = &mut self.looks[number];
        let mut colour = |what: &str| -> Result<[f32; 3], SceneError> {
            let mut words = words.by_ref().peekable();
            if words.peek().is_some_and(|w| matches!(*w, "spectral" | "xyz")) {
                return Ok([1.0; 3]);
            }
            let [first] = numbers::<1>(line, &mut words, what)?.map(|x| x as f32);
            // One number stands for all three.
            let rest: Vec<f32> = words.map_while(|w| w.parse().ok()).collect();
            let all = [first, *rest.first().unwrap_or(&first), *rest.get(1).unwrap_or(&first)];
            Ok(all.map(|c| if c.is_finite() { c } else { 0.0 }))
        };
        match word {
            "Kd" => look.diffuse = colour("Kd")?,
            "Ke" => look.emissive = colour("Ke")?,
            "Ks" => look.specular = colour("Ks")?,
            "Ns" => look.exponent = Some(colour("Ns")?[0]),
            "Pr" => look.roughness = Some(colour("Pr")?[0]),
            "Pm" => look.metallic = colour("Pm")?[0],
            "d" if colour("d").is_ok_and(|d| d[0] < 1.0) => {
                *self.ignored.entry("transparency (d)").or_default() += 1
            }
            "Tr" if colour("Tr").is_ok_and(|t| t[0] > 0.0) => {
                *self.ignored.entry("transparency (Tr)").or_default() += 1
            }
            "Pc" | "Pcr" | "Ps" | "aniso" | "anisor" | "Tf" => {
                *self.ignored.entry("coats, sheen and filters").or_default() += 1;
            }
            _ => {}
        }
        Ok(())
    }

    fn texture(&mut self, number: usize, word: &str, rest: &str, beside: Option<&Path>, limits: &Limits) {
        let slot = match word {
            "map_Kd" => 0,
            "map_Ke" => 1,
            "norm" => 2,
            "map_bump" | "map_Bump" | "bump" => return *self.ignored.entry("bump maps").or_default() += 1,
            "map_d" => return *self.ignored.entry("maps of transparency").or_default() += 1,
            _ => return *self.ignored.entry("other maps").or_default() += 1,
        };
        // Options stand before the name, and only then the name can have no blanks.
        let name = if rest.starts_with('-') {
            rest.rsplit(char::is_whitespace).next().unwrap_or(rest)
        } else {
            rest
        };
        let uri = uri_of(name);
        if !self.pictures.contains_key(&uri) {
            if self.pictures.len() == MOST_FILES {
                return *self.ignored.entry("maps beyond the 4096th").or_default() += 1;
            }
            let made = match picture(&uri, beside, limits) {
                Ok(()) => {
                    self.uris.push(uri.clone());
                    Some(self.uris.len() - 1)
                }
                Err(why) => {
                    self.missing.push(format!("{name} ({why})"));
                    None
                }
            };
            self.pictures.insert(uri.clone(), made);
        }
        let picture = self.pictures[&uri];
        let look = &mut self.looks[number];
        *[&mut look.map, &mut look.emissive_map, &mut look.normal_map][slot] = picture;
    }

    /// The materials of these numbers as JSON of glTF.
    pub(super) fn materials(&self, numbers: &BTreeSet<usize>) -> Vec<Value> {
        numbers.iter().map(|number| self.looks[*number].to_gltf()).collect()
    }

    /// What is not reproduced, each kind once.
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut told = self.told.clone();
        if !self.undeclared.is_empty() {
            let names = self.undeclared.iter().take(SHOWN).map(|name| super::shortened(name));
            let names = names.collect::<Vec<_>>().join(", ");
            told.push(format!("materials that no file describes are white: {names}"));
        }
        if let Some(first) = self.missing.first() {
            let more = if self.missing.len() > 1 {
                format!(" and {} more", self.missing.len() - 1)
            } else {
                String::new()
            };
            told.push(format!("files of materials are left out: {first}{more}"));
        }
        if !self.ignored.is_empty() {
            let all: Vec<String> =
                self.ignored.iter().map(|(what, times)| format!("{what} ({times} times)")).collect();
            told.push(format!("materials have what is not reproduced: {}", all.join(", ")));
        }
        told
    }
}
