//! What compilers made of the passes, as rows: measured, written, read.

use crate::cases::{Case, COAT, EVERY_LOBE};
use crate::targets::Target;
use dpm_render::gpu::{Executable, Gpu, GpuOptions};
use dpm_render::Program;
use serde::{Deserialize, Serialize};

/// What one compiler made of one pass.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Scene, and method unless it is `dpm`.
    pub case: String,
    /// Name of the pass.
    pub pass: String,
    /// Name of the target.
    pub target: String,
    /// Vector registers a lane.
    pub registers: u32,
    /// Registers that were spilled: to memory, and scalar ones to lanes of vector registers. NVK does not count them: they show in `scratch`.
    pub spills: u32,
    /// Memory for spilled registers and arrays: bytes a lane on NVIDIA, bytes a wave on AMD.
    pub scratch: u32,
    /// Waves of 32 lanes that a SIMD holds, as RADV counts them; `None`: the driver does not say.
    pub waves: Option<u32>,
    /// Lanes of a subgroup.
    pub subgroup: u32,
    /// Instructions.
    pub instructions: u32,
    /// Size of the program.
    pub code_bytes: u32,
    /// Whether rays walk through the scene in this pass.
    pub walks: bool,
    /// Whether the driver is a current one.
    pub current: bool,
}

/// What a driver was given: a pass with its shader and constants, as one number.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Input {
    /// As in [`Row`].
    pub case: String,
    /// As in [`Row`].
    pub pass: String,
    /// FNV-1a of the SPIR-V and the constants.
    pub digest: String,
}

/// The table.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Table {
    /// What the drivers were given.
    pub inputs: Vec<Input>,
    /// Name and version of the driver of each target, as it says itself.
    pub drivers: Vec<(String, String)>,
    /// What they made of it.
    pub passes: Vec<Row>,
}

/// What is added to the name of a pass whose shader leaves to the device what its rays meet.
pub const BY_QUERY: &str = " by ray query";

/// The name of a program in the table.
fn name_of(program: &Program, by_query: bool) -> String {
    format!("{}{}", program.pass, if by_query { BY_QUERY } else { "" })
}

/// Whether rays of this pass are traced by the device, if it can.
pub fn is_by_query(pass: &str) -> bool {
    pass.ends_with(BY_QUERY)
}

/// The digests of all programs of a case.
pub fn inputs(case: &Case) -> Vec<Input> {
    let digest = |program: &Program| {
        let constants: Vec<u8> = program
            .constants
            .iter()
            .flat_map(|(id, value)| [id.to_le_bytes(), value.to_le_bytes()].concat())
            .collect();
        let parts = [("spirv", program.shader.spirv), ("constants", &constants)];
        format!("{:016x}", dpm_shaders::generate::source_hash(parts.into_iter()))
    };
    let input = |p: &Program, by_query| Input {
        case: case.name.clone(),
        pass: name_of(p, by_query),
        digest: digest(p),
    };
    let (walks, queries) = (case.plan.programs(), case.plan.programs_with_queries());
    walks.iter().map(|p| input(p, false)).chain(queries.iter().map(|p| input(p, true))).collect()
}

/// The first of these statistics that the driver has.
fn first(made: &[Executable], names: &[&str]) -> Option<u32> {
    let value = |name: &&str| made.iter().filter_map(|m| m.get(name)).reduce(f64::max);
    names.iter().find_map(value).map(|v| v as u32)
}

fn row(
    case: &str,
    target: &Target,
    (program, by_query): (&Program, bool),
    made: &[Executable],
) -> Result<Row, String> {
    let need = |names: &[&str]| {
        let have: Vec<_> = made.iter().flat_map(|m| m.statistics.iter().map(|s| s.0.as_str())).collect();
        first(made, names)
            .ok_or_else(|| format!("{}: the driver says none of {names:?}, but {have:?}", target.name))
    };
    Ok(Row {
        case: case.to_owned(),
        pass: name_of(program, by_query),
        target: target.name.to_owned(),
        registers: need(&["VGPRs", "Number of GPRs"])?,
        spills: first(made, &["Spilled VGPRs"]).unwrap_or(0) + first(made, &["Spilled SGPRs"]).unwrap_or(0),
        scratch: need(&["Scratch size", "SLM Size", "SLM size"])?,
        waves: first(made, &["Subgroups per SIMD", "Max Waves"]),
        subgroup: made.iter().map(|m| m.subgroup_size).max().unwrap_or(0),
        instructions: need(&["Instructions", "Instruction count", "Instruction Count"])?,
        code_bytes: need(&["Code size", "Code Size"])?,
        walks: program.walks,
        current: target.current,
    })
}

/// Compiles every pipeline of all cases on the device that this process sees, as `target`. Returns the driver's own name with the rows. Shaders with
/// ray queries are left out for drivers that have none.
///
/// # Errors
/// The driver refuses something, does not say what it made, or has no ray query although the target should.
pub fn compile(cases: &[Case], target: &Target) -> Result<(String, Vec<Row>), String> {
    let options = GpuOptions { statistics: true, ..GpuOptions::default() };
    let gpu = Gpu::open(&options).map_err(|e| e.to_string())?;
    let summary = gpu.summary();
    if summary.ray_query != target.ray_query {
        return Err(format!("{}: its driver {} ray query", target.name, has(summary.ray_query)));
    }
    let mut rows = Vec::new();
    for case in cases {
        for (program, made) in case.plan.compile(&gpu).map_err(|e| e.to_string())? {
            rows.push(row(&case.name, target, (&program, false), &made)?);
        }
        if !target.ray_query {
            continue;
        }
        for (program, made) in case.plan.compile_with_queries(&gpu).map_err(|e| e.to_string())? {
            rows.push(row(&case.name, target, (&program, true), &made)?);
        }
    }
    Ok((format!("{}, {}", summary.name, summary.driver.trim()), rows))
}

fn has(it: bool) -> &'static str {
    if it {
        "has"
    } else {
        "has no"
    }
}

/// Compiles every pipeline of all cases on the device that this process sees, and returns a line for each program: all that the driver says of it.
///
/// # Errors
/// The driver refuses something.
pub fn everything_said(cases: &[Case]) -> Result<Vec<String>, String> {
    let options = GpuOptions { statistics: true, ..GpuOptions::default() };
    let gpu = Gpu::open(&options).map_err(|e| e.to_string())?;
    let summary = gpu.summary();
    let mut lines = vec![format!("{}, {}", summary.name, summary.driver.trim())];
    for case in cases {
        let started = std::time::Instant::now();
        let mut all: Vec<_> = case.plan.compile(&gpu).map_err(|e| e.to_string())?;
        let by_walk = all.len();
        if summary.ray_query {
            all.extend(case.plan.compile_with_queries(&gpu).map_err(|e| e.to_string())?);
        }
        for (i, (program, made)) in all.iter().enumerate() {
            lines.extend(made.iter().map(|m| {
                let said: Vec<_> =
                    m.statistics.iter().map(|(name, value)| format!("{name} {value}")).collect();
                format!(
                    "{}, {}: {}, subgroups of {}",
                    case.name,
                    name_of(program, i >= by_walk),
                    said.join(", "),
                    m.subgroup_size
                )
            }));
        }
        lines.push(format!("{}: all compiled in {:.1} s", case.name, started.elapsed().as_secs_f64()));
    }
    Ok(lines)
}

/// A line of the page: the worst of these rows.
fn line(pass: &str, target: &str, rows: &[&Row]) -> String {
    let most = |of: fn(&Row) -> u32| rows.iter().map(|r| of(r)).max().unwrap_or(0);
    let waves = rows.iter().filter_map(|r| r.waves).min().map_or("-".to_owned(), |w| w.to_string());
    format!(
        "| {pass} | {target} | {} | {} | {} | {waves} | {} | {:.1} |\n",
        most(|r| r.registers),
        most(|r| r.spills),
        most(|r| r.scratch),
        most(|r| r.instructions),
        f64::from(most(|r| r.code_bytes)) / 1024.0
    )
}

/// The line of a target whose driver has no ray query.
fn lacking(target: &str) -> String {
    match Target::named(target) {
        Some(target) if !target.ray_query => {
            format!("| no pass{BY_QUERY}: the driver has none | {} | - | - | - | - | - | - |\n", target.name)
        }
        _ => String::new(),
    }
}

impl Table {
    /// One line for each pass and driver: the worst of all cases without lobes of glTF's extensions. Then the tracer's passes of the cases that
    /// have such.
    pub fn markdown(&self) -> String {
        let mut text = String::from(
            "| pass | target | registers | spills | scratch, bytes | waves of 32 | instructions | code, KiB |\n\
             |---|---|---:|---:|---:|---:|---:|---:|\n",
        );
        let plain: Vec<&Row> =
            self.passes.iter().filter(|r| ![COAT, EVERY_LOBE].contains(&r.case.as_str())).collect();
        let mut seen = Vec::new();
        let mut target = None;
        for row in &plain {
            if let Some(last) = target.replace(&row.target).filter(|last| **last != row.target) {
                text.push_str(&lacking(last));
            }
            let key = (&row.pass, &row.target);
            if !seen.contains(&key) {
                seen.push(key);
                let same: Vec<&Row> = plain.iter().copied().filter(|r| (&r.pass, &r.target) == key).collect();
                text.push_str(&line(&row.pass, &row.target, &same));
            }
        }
        text.push_str(&target.map_or(String::new(), |last| lacking(last)));
        text.push_str(
            "\n| pass of a scene with lobes | target | registers | spills | scratch, bytes | waves of 32 | instructions | code, KiB |\n\
             |---|---|---:|---:|---:|---:|---:|---:|\n",
        );
        for case in [COAT, EVERY_LOBE] {
            let tracers = |r: &&Row| r.case == case && r.pass.starts_with("trace");
            for row in self.passes.iter().filter(tracers) {
                text.push_str(&line(&format!("{}, {case}", row.pass), &row.target, &[row]));
            }
        }
        text
    }

    /// The table as the committed file: one row a line.
    pub fn json(&self) -> String {
        let line = |value: serde_json::Value| value.to_string();
        let rows = |all: Vec<String>| all.join(",\n    ");
        let inputs = self.inputs.iter().map(|i| line(serde_json::json!(i))).collect();
        let drivers = self.drivers.iter().map(|d| line(serde_json::json!(d))).collect();
        let passes = self.passes.iter().map(|p| line(serde_json::json!(p))).collect();
        format!(
            "{{\n  \"inputs\": [\n    {}\n  ],\n  \"drivers\": [\n    {}\n  ],\n  \"passes\": [\n    {}\n  ]\n}}\n",
            rows(inputs),
            rows(drivers),
            rows(passes)
        )
    }
}
