//! Writes `glsl/generated.glsl` and `glsl/tables.glsl`, compiles every shader with `glslc`, and records the hash of the sources.
//!
//! Run as `cargo run -p dpm-shaders --bin build-shaders` after any change under `shaders/`.

use std::path::Path;
use std::process::{Command, ExitCode};

/// Sources that read tables: each is built twice.
const WITH_TABLES: &[&str] = &[
    "primary",
    "trace",
    "reproject_point",
    "reproject_bilinear",
    "rate_map",
    "schedule_budget",
    "schedule_blocks",
    "accumulate_samples",
    "accumulate_frames",
    "spatial_regression",
    "spatial_disk",
    "compensate",
    "halftone",
    "motion",
    "warp",
];

/// Output stem, source, extra defines.
fn variants() -> Vec<(String, String, Option<&'static str>)> {
    let source = |name: &str| format!("{name}.comp");
    let mut all: Vec<_> = WITH_TABLES
        .iter()
        .flat_map(|name| {
            [
                (format!("{name}.texel"), source(name), Some("-DTEXEL_TABLES")),
                (format!("{name}.storage"), source(name), None),
            ]
        })
        .collect();
    all.push(("pack".to_owned(), source("pack"), None));
    all
}

fn main() -> ExitCode {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let glsl = root.join("glsl");
    let spv = root.join("spv");
    std::fs::write(glsl.join("generated.glsl"), dpm_shaders::generate::generated_glsl())
        .expect("write generated.glsl");
    std::fs::write(glsl.join("tables.glsl"), dpm_shaders::generate::tables_glsl())
        .expect("write tables.glsl");
    std::fs::create_dir_all(&spv).expect("create spv");
    for (stem, source, define) in variants() {
        let output = spv.join(format!("{stem}.spv"));
        let status = Command::new("glslc")
            .args(["--target-env=vulkan1.1", "-O", "-Werror", "-I"])
            .arg(&glsl)
            .args(define)
            .arg(glsl.join(&source))
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
