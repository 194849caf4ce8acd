//! Loads every file that is named, and prints one line for each: what it holds, or why it is refused.

use std::path::Path;

fn main() {
    for file in std::env::args().skip(1) {
        let begin = std::time::Instant::now();
        let result = dpm_scene::load(Path::new(&file), &dpm_scene::LoadOptions::default());
        let ms = begin.elapsed().as_millis();
        match result {
            Ok(scene) => {
                let triangles: usize = scene.bodies.iter().map(|b| b.mesh.triangles.len()).sum();
                let (bodies, textures) = (scene.bodies.len(), scene.textures.len());
                println!(
                    "ok\t{file}\t{ms} ms\t{bodies} bodies, {triangles} triangles, {textures} textures\t{}",
                    scene.warnings.join(" | ")
                );
            }
            Err(e) => println!("refused\t{file}\t{ms} ms\t{e}"),
        }
    }
}
