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
    "prepare",
    "cells",
    "enlarge",
    "edges",
    "halftone",
    "motion",
    "warp",
    "walk",
];

/// Those of them whose rays walk through the scene: each is built a third time, for devices that trace rays themselves.
const WITH_QUERIES: &[&str] = &["primary", "trace", "edges"];

/// Parts of the pass `trace` for software Vulkan, where the host walks the rays: output, source, and a define beside that of texels.
const APART: &[(&str, &str, &str)] = &[
    ("trace_begin", "trace_begin", ""),
    ("trace_hits", "trace_hits", ""),
    ("trace_ends", "trace_hits", "-DENDS"),
    ("trace_misses", "trace_misses", ""),
    ("trace_sums", "trace_sums", ""),
];

/// Version of Vulkan for all shaders but those with ray queries.
const VULKAN: &str = "--target-env=vulkan1.1";
/// The same for shaders with ray queries, whose SPIR-V names the tree over the bodies among the inputs of its entry point.
const VULKAN_OF_QUERIES: &str = "--target-env=vulkan1.2";

/// Output stem, source, extra defines, version of Vulkan.
fn variants() -> Vec<(String, String, Vec<&'static str>, &'static str)> {
    let source = |name: &str| format!("{name}.comp");
    let mut all: Vec<_> = WITH_TABLES
        .iter()
        .flat_map(|name| {
            [
                (format!("{name}.texel"), source(name), vec!["-DTEXEL_TABLES"], VULKAN),
                (format!("{name}.storage"), source(name), vec![], VULKAN),
            ]
        })
        .collect();
    let query = |name: &&str| (format!("{name}.query"), source(name), vec!["-DRAY_QUERY"], VULKAN_OF_QUERIES);
    all.extend(WITH_QUERIES.iter().map(query));
    let apart = |(output, name, define): &(&str, &str, &'static str)| {
        let defines = ["-DTEXEL_TABLES", define].into_iter().filter(|d| !d.is_empty()).collect();
        (format!("{output}.texel"), source(name), defines, VULKAN)
    };
    all.extend(APART.iter().map(apart));
    all.push(("pack".to_owned(), source("pack"), vec![], VULKAN));
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
    for (stem, source, defines, vulkan) in variants() {
        let output = spv.join(format!("{stem}.spv"));
        let status = Command::new("glslc")
            .args([vulkan, "-O", "-Werror", "-I"])
            .arg(&glsl)
            .args(defines)
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
