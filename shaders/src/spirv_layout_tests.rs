//! Offsets, strides and specialization constants of the committed SPIR-V against those that are declared in Rust.
//!
//! Optimised SPIR-V has no names, so blocks are found by their bindings: each holds an array of one shared struct, or one struct.

use crate::specialization;
use crate::structs::{self, layout, BINDINGS, TREE_BINDING};
use std::collections::{BTreeSet, HashMap};

/// The instructions that say how blocks lie in memory.
#[derive(Default)]
struct Module {
    /// Variable to binding.
    bindings: HashMap<u32, u32>,
    /// Variable to pointer type.
    variables: HashMap<u32, u32>,
    /// Pointer type to what it points at.
    pointers: HashMap<u32, u32>,
    /// Struct type to its members' types.
    structs: HashMap<u32, Vec<u32>>,
    /// Types of numbers and vectors, as `f` and `u` for each number.
    numbers: HashMap<u32, String>,
    /// Array type to its element's type.
    arrays: HashMap<u32, u32>,
    /// Array type to its stride.
    strides: HashMap<u32, u32>,
    /// Struct type and member to the offset.
    offsets: HashMap<(u32, u32), u32>,
    /// Specialization constant to its id.
    constant_ids: HashMap<u32, u32>,
    /// Specialization constant to its type in GLSL and its default.
    constants: HashMap<u32, (&'static str, u32)>,
}

/// Reads a module; only the instructions needed here, by their numbers in the SPIR-V specification.
fn parse(spirv: &[u8]) -> Module {
    let words: Vec<u32> =
        spirv.chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    assert_eq!(words[0], 0x0723_0203, "SPIR-V's magic number");
    let mut module = Module::default();
    let mut at = 5;
    while at < words.len() {
        let (count, opcode) = ((words[at] >> 16) as usize, words[at] & 0xffff);
        assert!(count > 0, "an instruction without length");
        let w = &words[at + 1..at + count];
        match opcode {
            21 => drop(module.numbers.insert(w[0], if w[2] == 1 { "i" } else { "u" }.to_owned())),
            22 => drop(module.numbers.insert(w[0], "f".to_owned())),
            23 => {
                let of = module.numbers.get(&w[1]).cloned().unwrap_or_default();
                module.numbers.insert(w[0], of.repeat(w[2] as usize));
            }
            28 | 29 => drop(module.arrays.insert(w[0], w[1])),
            30 => drop(module.structs.insert(w[0], w[1..].to_vec())),
            32 => drop(module.pointers.insert(w[0], w[2])),
            48 => drop(module.constants.insert(w[1], ("bool", 1))),
            49 => drop(module.constants.insert(w[1], ("bool", 0))),
            50 => drop(module.constants.insert(w[1], ("uint", w[2]))),
            59 => drop(module.variables.insert(w[1], w[0])),
            71 if w[1] == 1 => drop(module.constant_ids.insert(w[0], w[2])),
            71 if w[1] == 6 => drop(module.strides.insert(w[0], w[2])),
            71 if w[1] == 33 => drop(module.bindings.insert(w[0], w[2])),
            72 if w[2] == 35 => drop(module.offsets.insert((w[0], w[1]), w[3])),
            _ => {}
        }
        at += count;
    }
    module
}

impl Module {
    /// The numbers of a struct's members, as `structs::members_of`.
    fn members(&self, id: u32) -> String {
        let members: Vec<_> = self.structs[&id].iter().map(|m| self.numbers.get(m).cloned()).collect();
        members.into_iter().map(Option::unwrap_or_default).collect::<Vec<_>>().join(",")
    }
}

/// The Rust structs behind each binding that holds some, and their sizes.
const BLOCKS: &[(&str, &str, usize)] = &[
    ("B_FRAME", "Frame", size_of::<structs::Frame>()),
    ("B_INSTANCES", "Instance", size_of::<structs::Instance>()),
    ("B_BODY_NODES", "BodyNode", size_of::<structs::BodyNode>()),
    ("B_TRIANGLE_REFS", "TriangleRef", size_of::<structs::TriangleRef>()),
    ("B_VERTICES", "Vertex", size_of::<structs::Vertex>()),
    ("B_MATERIALS", "Material", size_of::<structs::Material>()),
    ("B_TEXTURES", "TextureInfo", size_of::<structs::TextureInfo>()),
    ("B_LIGHTS", "Light", size_of::<structs::Light>()),
    ("B_TEXELS", "Texel", size_of::<structs::Texel>()),
    ("B_ENVIRONMENT", "SkyTexel", size_of::<structs::SkyTexel>()),
    ("B_ALBEDO", "AlbedoCell", size_of::<structs::AlbedoCell>()),
    ("B_SURFACES", "SurfaceHit", size_of::<structs::SurfaceHit>()),
    ("B_SURFACES", "Barycentric", size_of::<structs::Barycentric>()),
    ("B_COUNTERS", "Counters", size_of::<structs::Counters>()),
    ("B_GUIDES", "Sight", size_of::<structs::Sight>()),
    ("B_GUIDES", "Tint", size_of::<structs::Tint>()),
    ("B_GUIDES", "Shift", size_of::<structs::Shift>()),
    ("B_HISTORY", "HistoryLight", size_of::<structs::HistoryLight>()),
    ("B_HISTORY", "HistoryPlace", size_of::<structs::HistoryPlace>()),
    ("B_HISTORY", "HistoryNoise", size_of::<structs::HistoryNoise>()),
    ("B_HISTORY", "HistoryTag", size_of::<structs::HistoryTag>()),
    ("B_HISTORY", "HistorySeed", size_of::<structs::HistorySeed>()),
    ("B_HISTORY", "HistoryUsed", size_of::<structs::HistoryUsed>()),
    ("B_FORMER", "HistoryLight", size_of::<structs::HistoryLight>()),
    ("B_FORMER", "HistoryPlace", size_of::<structs::HistoryPlace>()),
    ("B_FORMER", "HistoryNoise", size_of::<structs::HistoryNoise>()),
    ("B_FORMER", "HistoryTag", size_of::<structs::HistoryTag>()),
    ("B_FORMER", "HistorySeed", size_of::<structs::HistorySeed>()),
    ("B_FILTERED", "Filtered", size_of::<structs::Filtered>()),
    ("B_SCHEDULE", "Schedule", size_of::<structs::Schedule>()),
    ("B_WORK", "WorkItem", size_of::<structs::WorkItem>()),
    ("B_MOTION", "Moved", size_of::<structs::Moved>()),
    ("B_MOVERS", "Mover", size_of::<structs::Mover>()),
    ("B_PLANE_GROUPS", "PlaneGroup", size_of::<structs::PlaneGroup>()),
];

fn offsets_of(name: &str) -> Vec<usize> {
    layout().iter().filter(|(s, _, _)| *s == name).map(|(_, _, offset)| *offset).collect()
}

fn assert_struct(module: &Module, what: &str, id: u32, name: &str) {
    let expected = offsets_of(name);
    let found: Vec<usize> = (0..module.structs[&id].len() as u32)
        .map(|m| module.offsets.get(&(id, m)).map_or(usize::MAX, |o| *o as usize))
        .collect();
    assert_eq!(found, expected, "{what}: members of {name}");
}

#[test]
fn offsets_and_strides_are_those_of_the_rust_structs() {
    let mut seen = BTreeSet::new();
    for shader in crate::ALL {
        let module = parse(shader.spirv);
        assert!(!module.bindings.is_empty(), "{}", shader.name);
        for (variable, binding) in &module.bindings {
            if *binding == TREE_BINDING.1 {
                // The tree over the bodies has no layout.
                assert!(shader.name.ends_with(".query"), "{}", shader.name);
                continue;
            }
            let (binding_name, _) = (BINDINGS.iter())
                .find(|(_, b)| b == binding)
                .unwrap_or_else(|| panic!("{}: binding {binding} is not in BINDINGS", shader.name));
            let known: Vec<_> = BLOCKS.iter().filter(|(b, _, _)| b == binding_name).collect();
            if known.is_empty() {
                continue;
            }
            let what = format!("{} {binding_name}", shader.name);
            // variable -> pointer -> block -> struct, or -> runtime array -> struct
            let block = module.pointers[&module.variables[variable]];
            let Some(members) = module.structs.get(&block) else {
                // Rows of a texel buffer: `generate` reads them in the order of the Rust struct's members.
                assert!(
                    structs::TEXEL_BINDINGS.contains(binding_name) && shader.name.ends_with(".texel"),
                    "{what}"
                );
                continue;
            };
            let member = members[0];
            assert_eq!(module.offsets[&(block, 0)], 0, "{what}");
            let id = module.arrays.get(&member).copied().unwrap_or(member);
            if !module.structs.contains_key(&id) {
                // Numbers in a buffer that has parts, or rows that `generate` writes in the order of the Rust struct's members.
                let is_number =
                    structs::PARTS.iter().any(|p| p.binding == *binding_name && p.element.is_empty());
                let is_row = shader.name.ends_with(".texel")
                    && structs::tables().iter().any(|t| t.storage == *binding_name && t.storage != t.texel);
                assert!(is_number || is_row, "{what}");
                continue;
            }
            // The parts of a buffer are told by their members.
            let members = module.members(id);
            let Some(&&(_, name, size)) =
                known.iter().find(|(_, name, _)| known.len() == 1 || structs::members_of(name) == members)
            else {
                panic!("{what}: nothing of {known:?} has the members {members}");
            };
            if let Some(stride) = module.strides.get(&member) {
                assert_eq!(*stride as usize, size, "{what}: stride");
            }
            assert_struct(&module, &what, id, name);
            seen.insert(name);
            if name == "Material" {
                // The last members before the padding are structs themselves.
                let texture_use = module.structs[&id][module.structs[&id].len() - 2];
                assert_struct(&module, &what, texture_use, "TextureUse");
                seen.insert("TextureUse");
            }
        }
    }
    let all: BTreeSet<_> = layout().iter().map(|(name, _, _)| *name).collect();
    let unseen: Vec<_> = all.difference(&seen).collect();
    assert!(unseen.is_empty(), "no shader was checked for {unseen:?}: add its binding to BLOCKS");
}

#[test]
fn a_wrong_offset_is_found() {
    // The test above must be able to fail: move one member of one struct in a copy of a shader.
    let mut words: Vec<u8> = crate::COMPENSATE.storage.spirv.to_vec();
    let module = parse(&words);
    let (&(id, member), &offset) =
        module.offsets.iter().filter(|(_, o)| **o > 0).min_by_key(|(k, _)| **k).expect("members");
    let pattern: Vec<u8> =
        [5 << 16 | 72, id, member, 35, offset].iter().flat_map(|w: &u32| w.to_le_bytes()).collect();
    let at = words.windows(pattern.len()).position(|w| w == pattern).expect("the decoration is there");
    words[at + 16] ^= 4;
    assert_eq!(parse(&words).offsets[&(id, member)], offset ^ 4);
}

#[test]
fn every_constant_has_the_id_the_type_and_the_default_of_its_declaration() {
    let mut used = BTreeSet::new();
    for shader in crate::ALL {
        let module = parse(shader.spirv);
        for (constant, &id) in &module.constant_ids {
            let declared = &specialization::ALL[id as usize];
            let found = module.constants[constant];
            let expected = (declared.glsl_type, declared.default);
            assert_eq!(found, expected, "{} {}", shader.name, declared.name);
            used.insert(id);
        }
    }
    let unused: Vec<_> =
        specialization::ALL.iter().filter(|c| !used.contains(&c.id)).map(|c| c.name).collect();
    assert!(unused.is_empty(), "no shader uses {unused:?}");
}

#[test]
fn only_the_generated_file_declares_constants() {
    let glsl = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("glsl");
    for entry in std::fs::read_dir(glsl).expect("the folder of shaders") {
        let path = entry.expect("a file").path();
        let declares = std::fs::read_to_string(&path).expect("a text").contains("constant_id");
        assert_eq!(declares, path.ends_with("generated.glsl"), "{}", path.display());
    }
}
