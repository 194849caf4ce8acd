//! Writes `glsl/generated.glsl` and `glsl/scene_rows.glsl`, compiles every shader with `glslc`, and records the hash of the sources.
//!
//! Run as `cargo run -p dpm-shaders --bin build-shaders` after any change under `shaders/`.

use std::path::Path;
use std::process::{Command, ExitCode};

/// Output stem, source, extra defines.
const VARIANTS: &[(&str, &str, &[&str])] = &[
    ("primary.texel", "primary.comp", &["-DSCENE_TEXELS"]),
    ("primary.storage", "primary.comp", &[]),
    ("trace.texel", "trace.comp", &["-DSCENE_TEXELS"]),
    ("trace.storage", "trace.comp", &[]),
    ("reproject.texel", "reproject.comp", &["-DSCENE_TEXELS"]),
    ("reproject.storage", "reproject.comp", &[]),
    ("rate_map", "rate_map.comp", &[]),
    ("schedule", "schedule.comp", &[]),
    ("accumulate", "accumulate.comp", &[]),
    ("spatial", "spatial.comp", &[]),
    ("compensate.texel", "compensate.comp", &["-DSCENE_TEXELS"]),
    ("compensate.storage", "compensate.comp", &[]),
    ("pack", "pack.comp", &[]),
];

fn main() -> ExitCode {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let glsl = root.join("glsl");
    let spv = root.join("spv");
    std::fs::write(glsl.join("generated.glsl"), dpm_shaders::generate::generated_glsl())
        .expect("write generated.glsl");
    std::fs::write(glsl.join("scene_rows.glsl"), dpm_shaders::generate::scene_rows_glsl())
        .expect("write scene_rows.glsl");
    std::fs::create_dir_all(&spv).expect("create spv");
    for (stem, source, defines) in VARIANTS {
        let output = spv.join(format!("{stem}.spv"));
        let status = Command::new("glslc")
            .args(["--target-env=vulkan1.1", "-O", "-Werror", "-I"])
            .arg(&glsl)
            .args(*defines)
            .arg(glsl.join(source))
            .arg("-o")
            .arg(&output)
            .status();
        match status {
            Ok(s) if s.success() => {
                println!("{stem}.spv {} bytes", std::fs::metadata(&output).map_or(0, |m| m.len()))
            }
            Ok(s) => {
                eprintln!("glslc failed on {source}: {s}");
                return ExitCode::FAILURE;
            }
            Err(e) => {
                eprintln!("cannot run glslc ({e}); install it: apt-get install glslc");
                return ExitCode::FAILURE;
            }
        }
    }
    let hash = dpm_shaders::generate::hash_directory(&glsl).expect("read glsl");
    std::fs::write(spv.join("sources.hash"), format!("{hash:016x}\n")).expect("write hash");
    ExitCode::SUCCESS
}
