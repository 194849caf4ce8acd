//! Rust types into GLSL text, and a hash that tells whether committed SPIR-V belongs to the sources.

use crate::{specialization, structs};

/// A type that can be a member of a shared struct.
pub trait GlslType {
    /// The member's declaration, with indentation and line end.
    fn member(name: &str) -> String;
    /// The value, from the words of the rows r0, r1, ... that begin with `word`, which moves past them.
    fn read(word: &mut usize) -> String;
    /// The words of the value `of`, as a list for the constructor of a row; empty for anything that no shader writes as a row.
    fn words(_of: &str) -> String {
        String::new()
    }
    /// `f` for each float, `i` for each integer with a sign and `u` for each other one of a number or vector; empty for anything else.
    fn numbers() -> String {
        String::new()
    }
}

macro_rules! glsl_types {
    ($($rust:ty => $glsl:literal, $words:literal by $cast:literal;)*) => {$(
        impl GlslType for $rust {
            fn member(name: &str) -> String {
                format!("    {} {name};\n", $glsl)
            }
            fn read(word: &mut usize) -> String {
                let words: Vec<_> = (0..$words).map(|_| cast(word, $cast)).collect();
                if words.len() == 1 { words[0].clone() } else { format!("{}({})", $glsl, words.join(", ")) }
            }
            fn words(of: &str) -> String {
                match ($cast, $words) {
                    ("uintBitsToFloat", _) => format!("floatBitsToUint({of})"),
                    ("int", 1) => format!("uint({of})"),
                    ("int", n) => format!("uvec{n}({of})"),
                    _ => of.to_owned(),
                }
            }
            fn numbers() -> String {
                match $cast {
                    "uintBitsToFloat" => "f",
                    "int" => "i",
                    _ => "u",
                }
                .repeat($words)
            }
        }
    )*};
}

/// One word of the rows, as `by` makes it of a uint.
fn cast(word: &mut usize, by: &str) -> String {
    let (row, column) = (*word / 4, ["x", "y", "z", "w"][*word % 4]);
    *word += 1;
    if by.is_empty() {
        format!("r{row}.{column}")
    } else {
        format!("{by}(r{row}.{column})")
    }
}

glsl_types! {
    f32 => "float", 1 by "uintBitsToFloat";
    u32 => "uint", 1 by "";
    i32 => "int", 1 by "int";
    [i32; 2] => "ivec2", 2 by "int";
    [i32; 4] => "ivec4", 4 by "int";
    [f32; 2] => "vec2", 2 by "uintBitsToFloat";
    [f32; 3] => "vec3", 3 by "uintBitsToFloat";
    [f32; 4] => "vec4", 4 by "uintBitsToFloat";
    [u32; 3] => "uvec3", 3 by "";
    [u32; 4] => "uvec4", 4 by "";
    [u32; 2] => "uvec2", 2 by "";
}

impl GlslType for u64 {
    fn member(name: &str) -> String {
        format!("    uint64_t {name};\n")
    }
    fn read(word: &mut usize) -> String {
        format!("packUint2x32({})", <[u32; 2]>::read(word))
    }
}

impl GlslType for structs::TextureUse {
    fn member(name: &str) -> String {
        format!("    TextureUse {name};\n")
    }
    fn read(word: &mut usize) -> String {
        Self::read_members(word)
    }
}

impl GlslType for structs::Rows {
    fn member(name: &str) -> String {
        format!("    vec4 {name}[3];\n")
    }
    fn read(word: &mut usize) -> String {
        let rows: Vec<_> = (0..3).map(|_| <[f32; 4]>::read(word)).collect();
        format!("vec4[3]({})", rows.join(", "))
    }
}

/// Bits of the shuffled index that reach the Sobol matrices: a sequence repeats its points, in another order, after 2^16 samples.
pub const SOBOL_BITS: usize = 16;

/// The text of `glsl/generated.glsl`.
pub fn generated_glsl() -> String {
    let mut out = String::from(
        "// Written by build-shaders from shaders/src/structs.rs and shaders/src/specialization.rs. Do not edit.\n\n\
         #extension GL_EXT_shader_explicit_arithmetic_types_int64 : require\n\n",
    );
    for (name, value) in structs::CONSTANTS.iter().chain(structs::BINDINGS).chain([&structs::TREE_BINDING]) {
        out.push_str(&format!("#define {name} {value}u\n"));
    }
    out.push_str("// Index of a pixel's element in a part of a buffer.\n");
    for part in structs::PARTS.iter().filter(|part| part.binding != "B_FORMER") {
        let ([block, first], last) = (part.steps(), structs::PART_BLOCK - 1);
        let shift = structs::PART_BLOCK.ilog2();
        let name = macro_of(part);
        out.push_str(&format!(
            "#define {name}(i) (((i) >> {shift}u) * {block}u + {first}u + ((i) & {last}u))\n"
        ));
    }
    out.push_str(&format!("// Sobol dimensions 1 to 3 of the lowest {SOBOL_BITS} bits of an index, without branch or table look-up.\n"));
    out.push_str("#define SOBOL_123(i) uvec3(");
    let dimension = |row: &[u32; 32]| -> String {
        let terms = row[..SOBOL_BITS].iter().enumerate();
        terms
            .map(|(b, v)| format!("(uint(bitfieldExtract(int(i), {b}, 1)) & {v}u)"))
            .collect::<Vec<_>>()
            .join(" ^ ")
    };
    out.push_str(&sobol_rows().each_ref().map(dimension).join(", "));
    out.push_str(")\n");
    out.push_str("\n// The host sets these before the first frame. What they switch off is compiled away.\n");
    for constant in specialization::ALL {
        out.push_str(&constant.glsl());
    }
    out.push('\n');
    out.push_str(&structs::glsl());
    out
}

/// Name of the macro for the index of a pixel's element. Former histories lie as those of the frame do.
fn macro_of(part: &structs::Part) -> String {
    let binding = part.binding.trim_start_matches("B_").replace("FORMER", "HISTORY");
    format!("{binding}_{}_AT", part.name.to_uppercase())
}

/// The text of `glsl/tables.glsl`: how tables are read, and written by `set_{reader}`.
pub fn tables_glsl() -> String {
    let mut out = String::from(
        "// Written by build-shaders from shaders/src/structs.rs. Do not edit.\n//\n// Tables: storage on GPUs; rows of texel buffers on \
         software Vulkan, which reads storage lane by lane where lanes part. What is\n// not used of an element is not read. Software Vulkan \
         writes lane by lane too, member by member, so there an element is written as one row.\n",
    );
    let mut declared = Vec::new();
    let mut written = Vec::new();
    for structs::Table { name, reader, storage, texel, bytes, part, from_rows, from_storage, to_words } in
        structs::tables()
    {
        // The parts of a buffer share its image.
        let image = format!("{}_image", texel.trim_start_matches("B_").to_lowercase());
        let declaration = if declared.contains(&texel) {
            String::new()
        } else {
            format!("layout(set = 0, binding = {texel}, rgba32ui) uniform readonly uimageBuffer {image};\n")
        };
        declared.push(texel);
        let fetches: String = match bytes {
            4 => format!("    uvec4 r0 = uvec4(imageLoad({image}, int(at >> 2u))[at & 3u]);\n"),
            8 => format!(
                "    uvec4 row = imageLoad({image}, int(at >> 1u));\n    uvec4 r0 = (at & 1u) == 0u ? row : row.zwxy;\n"
            ),
            _ => (0..bytes / 16)
                .map(|row| format!("    uvec4 r{row} = imageLoad({image}, int(at) * {} + {row});\n", bytes / 16))
                .collect(),
        };
        let at = part.map_or("i".to_owned(), |part| format!("{}(i)", macro_of(&part)));
        // What only the pass `enlarge` reads, so that it changes nothing of the other shaders.
        let is_coarse = storage.starts_with("B_COARSE");
        out.push_str(if is_coarse { "\n#ifdef COARSE_TABLES" } else { "" });
        out.push_str(&format!(
            "\n#ifdef TEXEL_TABLES\n\
             {declaration}\
             {name} {reader}_at(uint i) {{\n    uint at = {at};\n{fetches}    return {from_rows};\n}}\n\
             #else\n\
             layout(set = 0, binding = {storage}, scalar) readonly buffer {reader}_block {{ {name} {reader}_table[]; }};\n\
             {name} {reader}_at(uint i) {{\n    uint at = {at};\n    return {from_storage};\n}}\n\
             #endif\n"
        ));
        out.push_str(if is_coarse { "#endif\n" } else { "" });
        // What some shader writes. Of `B_FORMER` the frame before wrote it.
        let row = match bytes {
            16 => "uvec4",
            8 => "uvec2",
            _ => "uint",
        };
        if storage == texel {
            continue;
        }
        let rows = format!("{}_{row}s", storage.trim_start_matches("B_").to_lowercase());
        let declaration = if written.contains(&rows) {
            String::new()
        } else {
            format!("layout(set = 0, binding = {storage}, scalar) writeonly buffer {rows}_block {{ {row} {rows}[]; }};\n")
        };
        out.push_str(if is_coarse { "\n#ifdef COARSE_TABLES" } else { "" });
        out.push_str(&format!(
            "\n#ifdef TEXEL_TABLES\n\
             {declaration}\
             void set_{reader}(uint i, {name} v) {{ {rows}[{at}] = {row}({to_words}); }}\n\
             #else\n\
             layout(set = 0, binding = {storage}, scalar) writeonly buffer {reader}_out_block {{ {name} {reader}_out[]; }};\n\
             void set_{reader}(uint i, {name} v) {{ {reader}_out[{at}] = v; }}\n\
             #endif\n"
        ));
        out.push_str(if is_coarse { "#endif\n" } else { "" });
        written.push(rows);
    }
    out
}

/// Direction numbers of Sobol dimensions 1 to 3 (\[JoeKuo08\]; dimension 0 is the bit reversal): polynomial and first numbers into 32 words.
pub fn sobol_rows() -> [[u32; 32]; 3] {
    // Degree, inner coefficients of the primitive polynomial, initial m.
    let rows: [(usize, u32, &[u32]); 3] = [(1, 0, &[1]), (2, 1, &[1, 3]), (3, 1, &[1, 3, 1])];
    rows.map(|(degree, inner, initial)| {
        let mut v = [0u32; 32];
        for (i, m) in initial.iter().enumerate() {
            v[i] = m << (31 - i);
        }
        for i in degree..32 {
            v[i] = v[i - degree] ^ (v[i - degree] >> degree);
            for k in 1..degree {
                if inner >> (degree - 1 - k) & 1 == 1 {
                    v[i] ^= v[i - k];
                }
            }
        }
        v
    })
}

/// FNV-1a over names and contents of all sources, in the order given: stands in `spv/sources.hash`.
pub fn source_hash<'a>(sources: impl Iterator<Item = (&'a str, &'a [u8])>) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    for (name, text) in sources {
        for &byte in name.as_bytes().iter().chain(&[0]).chain(text).chain(&[0]) {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
    hash
}

/// [`source_hash`] of all files in a folder, by name.
///
/// # Errors
/// The operating system's, when the folder cannot be read.
pub fn hash_directory(folder: &std::path::Path) -> std::io::Result<u64> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        files.push((name, std::fs::read(&path)?));
    }
    files.sort();
    Ok(source_hash(files.iter().map(|(name, text)| (name.as_str(), text.as_slice()))))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    #[test]
    fn committed_spirv_belongs_to_the_sources() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR"));
        let committed = std::fs::read_to_string(root.join("glsl/generated.glsl")).unwrap();
        let remedy = "run: cargo run -p dpm-shaders --bin build-shaders";
        assert_eq!(committed, super::generated_glsl(), "glsl/generated.glsl is stale; {remedy}");
        let rows = std::fs::read_to_string(root.join("glsl/tables.glsl")).unwrap();
        assert_eq!(rows, super::tables_glsl(), "glsl/tables.glsl is stale; {remedy}");
        let hash = super::hash_directory(&root.join("glsl")).unwrap();
        let recorded = std::fs::read_to_string(root.join("spv/sources.hash")).unwrap();
        assert_eq!(recorded.trim(), format!("{hash:016x}"), "spv/ is stale; {remedy}");
    }
}
