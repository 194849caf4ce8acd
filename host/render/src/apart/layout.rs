//! Where everything lies in the queue and in the control words of a frame whose rays the host walks.

use crate::gpu::Relay;
use crate::method::Method;
use crate::settings::RendererSettings;
use crate::tiles::TILE;
use dpm_device::planes::Raster;

/// Words of four u32 at the start of the queue: see `queue.glsl`.
const HEADER_ROWS: u32 = 4;
/// Row of the queue that says what a dispatch is about.
pub(crate) const NOW_ROW: usize = 2;
/// Most batches of samples of a frame.
const MOST_BATCHES: u32 = 8;
/// Room for the paths of one tile at least.
const FEWEST_PATHS: u64 = 4096;
/// Bytes of an entry of the control words: a row for the shaders, and the sizes of two dispatches.
pub(crate) const ENTRY_BYTES: usize = 64;
/// The word after the schedule: rays that were counted before those of paths.
pub(crate) const COUNTED_WORD: usize = 8;
/// Words of the schedule and of what was counted, which lie before the entries.
pub(crate) const SCHEDULE_WORDS: usize = 16;

/// The places, in rows of four words or in words, and the steps at which the host walks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct QueueLayout {
    /// Paths that have room.
    pub(crate) paths: u32,
    /// Samples of a batch. The last item of a batch may have as many more as a pixel has at most.
    pub(crate) batch: u32,
    /// Batches for which commands are recorded.
    pub(crate) batches: u32,
    /// Walks of a batch: one for each vertex from which rays start.
    pub(crate) vertices: u32,
    /// First row of the rays.
    pub(crate) rays_row: u32,
    /// First word of the hits.
    pub(crate) hits_word: u32,
    /// First word of each list.
    pub(crate) lists_word: [u32; 2],
    /// First row of the paths.
    pub(crate) paths_row: u32,
    /// Rows of a path.
    pub(crate) path_rows: u32,
    /// All rows.
    pub(crate) rows: u32,
    /// The last ray of a path only says whether there is anything: nothing glows.
    pub(crate) last_is_any: bool,
}

impl QueueLayout {
    /// For frames with these settings, in a buffer of at most `most_bytes`. `None`: a path has no ray or too many vertices, or a raster has no room.
    pub(crate) fn new(
        settings: &RendererSettings,
        absorbs: bool,
        glows: bool,
        most_bytes: u64,
    ) -> Option<Self> {
        let (raster, method) = (settings.raster, &settings.method);
        let vertices = settings.depth.checked_sub(1).filter(|v| *v > 0)?;
        let path_rows = if absorbs { 6 } else { 4 };
        // Rays, hits, lists and the path itself.
        let path_bytes = 2 * 32 + 2 * 4 + 2 * 4 + 16 * u64::from(path_rows);
        let pixels = u64::from(tiles(raster)) * u64::from(TILE * TILE);
        let wanted = most_samples(method, method.budget_spp, method.budget_spp as u32, pixels);
        let paths = wanted.max(FEWEST_PATHS).min((most_bytes - 4096) / path_bytes) as u32 & !3;
        let batch = paths.checked_sub(2 * method.most_spp()).filter(|b| *b > 0)?;
        let batches = (wanted.div_ceil(u64::from(batch)) as u32).clamp(1, MOST_BATCHES);
        let most = Relay::QUESTIONS as u32 / vertices;
        let batches = batches.min(most);
        if batches == 0 {
            return None;
        }
        let rays = 2 * paths;
        let rays_row = HEADER_ROWS;
        let hits_word = 4 * (rays_row + 2 * rays);
        let first_list = hits_word + rays.next_multiple_of(4);
        let lists_word = [first_list, first_list + paths];
        let paths_row = (first_list + 2 * paths) / 4;
        let rows = paths_row + path_rows * paths;
        let last_is_any = !glows;
        Some(Self {
            paths,
            batch,
            batches,
            vertices,
            rays_row,
            hits_word,
            lists_word,
            paths_row,
            path_rows,
            rows,
            last_is_any,
        })
    }

    /// Walks of a frame.
    pub(crate) fn steps(&self) -> u32 {
        self.batches * self.vertices
    }

    /// The batch and the vertex, from 0 on, of a walk.
    pub(crate) fn batch_and_vertex(&self, step: u32) -> (u32, u32) {
        (step / self.vertices, step % self.vertices)
    }

    /// Whether all samples of a frame surely have room that lists tiles of so many pixels.
    pub(crate) fn serves(&self, method: &Method, budget_spp: f32, spp: u32, pixels: u64) -> bool {
        most_samples(method, budget_spp, spp, pixels) <= u64::from(self.batch) * u64::from(self.batches)
    }

    /// Byte of the entry of a walk among the control words: what is dispatched after it.
    pub(crate) fn entry_of_step(step: u32) -> usize {
        4 * SCHEDULE_WORDS + step as usize * ENTRY_BYTES
    }

    /// Byte of the entry of a batch: its items.
    pub(crate) fn entry_of_batch(&self, batch: u32) -> usize {
        Self::entry_of_step(self.steps() + batch)
    }

    /// Bytes of the control words.
    pub(crate) fn control_bytes(&self) -> usize {
        self.entry_of_batch(self.batches)
    }

    /// The first two rows of the queue.
    pub(crate) fn header(&self) -> [[u32; 4]; 2] {
        let [list, _] = self.lists_word;
        [[self.rays_row, self.hits_word, list, self.paths_row], [self.paths, self.batch, 0, 0]]
    }
}

fn tiles(raster: Raster) -> u32 {
    raster.width().div_ceil(TILE) * raster.height().div_ceil(TILE)
}

/// No frame has more samples that lists so many pixels. Method `dpm` shares out its budget, lifts shares to half of the budget, gives pixels without
/// noise twice the budget, and rounds each up (`schedule_budget.comp`).
fn most_samples(method: &Method, budget_spp: f32, spp: u32, pixels: u64) -> u64 {
    let budget = f64::from(budget_spp.min(method.most_spp() as f32).max(0.0));
    let zones = if method.spp_by_angle { method.paper.zone_spp.into_iter().max().unwrap_or(0) } else { 0 };
    let each = if method.dpm { 3.0 * budget + 2.0 } else { 0.0 };
    (pixels as f64 * each.max(f64::from(spp.min(method.most_spp()).max(zones)))).ceil() as u64
}
