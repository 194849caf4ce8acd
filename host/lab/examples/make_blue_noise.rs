//! Writes the blue-noise masks that the renderer reads, or with `--check` says whether the committed ones are what the generator makes.

use std::process::ExitCode;

use dpm_lab::blue_noise::generate_mask;
use dpm_render::blue_noise::MASK;

fn main() -> ExitCode {
    let made = generate_mask();
    if std::env::args().any(|a| a == "--check") {
        let same = made == MASK;
        println!("the committed masks {} what the generator makes", if same { "are" } else { "are not" });
        return if same { ExitCode::SUCCESS } else { ExitCode::FAILURE };
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../render/src/data/blue_noise_64x64x32x2.bin");
    match std::fs::write(path, made) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("cannot write {path}: {e}");
            ExitCode::FAILURE
        }
    }
}
