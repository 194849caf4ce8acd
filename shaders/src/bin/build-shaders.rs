//! Writes `glsl/generated.glsl` and `glsl/tables.glsl`, compiles every shader with `glslc`, and records the hash of the sources.
//!
//! Run as `cargo run -p dpm-shaders --bin build-shaders` after any change under `shaders/`.

use std::path::Path;
use std::process::{Command, ExitCode};

/// Sources that read tables: each is built twice, and some a third time.
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

/// Those of them whose rays walk through the scene: each is built a third time, for devices that trace rays themselves.
const WITH_QUERIES: &[&str] = &["primary", "trace"];

/// Version of Vulkan for all shaders but those with ray queries.
const VULKAN: &str = "--target-env=vulkan1.1";
/// The same for shaders with ray queries, whose SPIR-V names the tree over the bodies among the inputs of its entry point.
const VULKAN_OF_QUERIES: &str = "--target-env=vulkan1.2";

/// Output stem, source, extra defines, version of Vulkan.
fn variants() -> Vec<(String, String, Option<&'static str>, &'static str)> {
    let source = |name: &str| format!("{name}.comp");
    let mut all: Vec<_> = WITH_TABLES
        .iter()
        .flat_map(|name| {
            [
                (format!("{name}.texel"), source(name), Some("-DTEXEL_TABLES"), VULKAN),
                (format!("{name}.storage"), source(name), None, VULKAN),
            ]
        })
        .collect();
    let query = |name: &&str| (format!("{name}.query"), source(name), Some("-DRAY_QUERY"), VULKAN_OF_QUERIES);
    all.extend(WITH_QUERIES.iter().map(query));
    all.push(("pack".to_owned(), source("pack"), None, VULKAN));
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
    for (stem, source, define, vulkan) in variants() {
        let output = spv.join(format!("{stem}.spv"));
        let status = Command::new("glslc")
            .args([vulkan, "-O", "-Werror", "-I"])
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
