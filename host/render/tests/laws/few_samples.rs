//! Frames that have fewer samples than pixels (method `dpm`): a surface that has just come into view is shown all the same.

use super::scale::{balls, dpm, view_of_balls};
use dpm_render::Scale;
use glam::Vec3;

/// What draws frames.
mod breadth {
    use super::*;

    /// Nothing is known of any surface before the first frame. With one sample for eight pixels most of them still show light, because their neighbours
    /// have some, or because the light of the scene is about what they reflect. None is dark, and the picture is as bright as with all samples.
    #[test]
    fn a_new_surface_is_shown_by_however_few_samples() {
        let scene = balls();
        let view = view_of_balls(&scene);
        let truth = view.truth(view.camera.raster);
        let mean = |light: &[Vec3]| {
            let lit = || (0..truth.len()).filter(|&i| truth[i].is_some_and(|(_, lit)| lit));
            lit().map(|i| f64::from(light[i].element_sum())).sum::<f64>() / lit().count() as f64
        };
        let many = mean(&view.show_by(4.0, Scale::WHOLE, &dpm(), &[0; 24]).light);
        for (budget, share) in [(0.5, 1.0), (0.25, 1.0), (0.125, 1.0), (0.125, 0.5)] {
            let shown = view.show_by(budget, Scale::Share(share), &dpm(), &[0]);
            let is_dark = |i: usize| truth[i].is_some_and(|(_, lit)| lit) && shown.codes[i] == 0;
            let lit = truth.iter().flatten().filter(|(_, lit)| *lit).count();
            let dark = (0..truth.len()).filter(|&i| is_dark(i)).count();
            let relative = mean(&shown.light) / many;
            println!(
                "{budget} samples a pixel, scale {share}: {dark} dark pixels, {relative:.3} of the light"
            );
            // A pixel stays dark whose only sample is, if too few pixels around it have any.
            assert!(
                dark <= lit / 500,
                "{dark} of {lit} lit pixels are dark with {budget} samples a pixel at scale {share}"
            );
            assert!((relative - 1.0).abs() < 0.05, "{relative} of the light with {budget} samples a pixel");
        }
    }
}
