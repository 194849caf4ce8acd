//! Tags and markers into light on the sensor.

use super::{BrightMarker, CameraOptics, MarkedBody, MockCameraConfig, PrintedTag};
use crate::motion::{add, cross, multiply, rotate, scale, sub, Motion};
use dpm_device::pose::Pose;
use dpm_device::tag36h11::{printed_cell, CELLS, PRINTED};

/// Share of light that white and black of a print reflect.
const WHITE: f64 = 0.95;
const BLACK: f64 = 0.05;
/// Grey level of a marker as a share of the brightest.
const MARKER: f64 = 0.95;

/// What of a body is painted.
enum PaintedContent<'a> {
    Tag(&'a PrintedTag),
    Marker(&'a BrightMarker),
}

/// Something to paint: a tag or a marker, and where in the picture it may be.
pub(super) struct Sheet<'a> {
    motion: &'a Motion,
    content: PaintedContent<'a>,
    /// From the camera in the middle of the exposure, metres.
    pub distance: f64,
    /// First and last column, and rows.
    columns: [usize; 2],
    rows: [usize; 2],
}

impl Sheet<'_> {
    /// First column and the one behind the last, and rows, in which something of it may lie.
    pub(super) fn extent(&self) -> [[usize; 2]; 2] {
        [self.columns, self.rows]
    }
}

fn inverse(q: [f64; 4]) -> [f64; 4] {
    [-q[0], -q[1], -q[2], q[3]]
}

/// `outer` after `inner`.
fn joined(outer: &Pose, inner: &Pose) -> Pose {
    Pose {
        position_m: add(outer.position_m, rotate(outer.rotation_xyzw, inner.position_m)),
        rotation_xyzw: multiply(outer.rotation_xyzw, inner.rotation_xyzw),
    }
}

/// A pose of the world in camera space.
fn in_camera(camera: &Pose, pose: &Pose) -> Pose {
    let back = inverse(camera.rotation_xyzw);
    Pose {
        position_m: rotate(back, sub(pose.position_m, camera.position_m)),
        rotation_xyzw: multiply(back, pose.rotation_xyzw),
    }
}

/// All tags and markers that may be in the picture whose first row begins at `begin_ns`.
pub(super) fn sheets<'a>(
    config: &MockCameraConfig,
    bodies: &'a [MarkedBody],
    begin_ns: i64,
) -> Vec<Sheet<'a>> {
    let end_ns = begin_ns + config.exposure_ns + config.row_ns * i64::from(config.optics.size[1]);
    let mut out = Vec::new();
    for body in bodies {
        // Poses between which the body does not move far.
        let poses: Vec<Pose> = (0..=8)
            .map(|i| in_camera(&config.pose, &body.motion.pose_at(begin_ns + (end_ns - begin_ns) * i / 8)))
            .collect();
        let tags = body.tags.iter().map(PaintedContent::Tag);
        for content in tags.chain(body.markers.iter().map(PaintedContent::Marker)) {
            let points: Vec<[f64; 3]> = poses.iter().flat_map(|p| outline(&content, p)).collect();
            let Some([columns, rows]) = extent(&config.optics, &points) else { continue };
            let middle = points[points.len() / 2];
            let distance = middle.iter().map(|c| c * c).sum::<f64>().sqrt();
            out.push(Sheet { motion: &body.motion, content, distance, columns, rows });
        }
    }
    out
}

/// Points in camera space between which it lies.
fn outline(content: &PaintedContent<'_>, body: &Pose) -> Vec<[f64; 3]> {
    match content {
        PaintedContent::Tag(tag) => {
            let tag_pose = joined(body, &tag.place);
            let half = 0.5 * tag.side_m * PRINTED as f64 / CELLS as f64;
            let corner = |x: f64, y: f64| {
                add(tag_pose.position_m, rotate(tag_pose.rotation_xyzw, [x * half, y * half, 0.0]))
            };
            vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)]
        }
        PaintedContent::Marker(marker) => {
            let middle = add(body.position_m, rotate(body.rotation_xyzw, marker.middle_m));
            let r = 1.2 * marker.radius_m;
            [[r, 0.0, 0.0], [-r, 0.0, 0.0], [0.0, r, 0.0], [0.0, -r, 0.0], [0.0, 0.0, r]]
                .map(|d| add(middle, d))
                .to_vec()
        }
    }
}

/// Columns and rows of the picture in which points lie, with a rim; `None` if they do not.
fn extent(optics: &CameraOptics, points: &[[f64; 3]]) -> Option<[[usize; 2]; 2]> {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for point in points {
        let pixel = optics.pixel(*point)?;
        for i in 0..2 {
            low[i] = low[i].min(pixel[i] - 3.0);
            high[i] = high[i].max(pixel[i] + 3.0);
        }
    }
    let range = |i: usize| {
        let most = f64::from(optics.size[i]);
        let inside = low[i] < most && high[i] > 0.0;
        inside.then_some([low[i].max(0.0) as usize, high[i].min(most) as usize])
    };
    Some([range(0)?, range(1)?])
}

/// A tag at an instant: from straight rays to places on it, and the light that white and black give.
#[derive(Clone, Copy)]
struct Plane {
    /// Rows of the map from `(x, y, -1)` in camera space to homogeneous cells from the upper left corner of the margin.
    map: [[f64; 3]; 3],
    white: f64,
    black: f64,
}

impl Plane {
    fn of(config: &MockCameraConfig, tag: &PrintedTag, body: &Pose) -> Option<Self> {
        let pose = joined(body, &tag.place);
        let axis = |v: [f64; 3]| rotate(pose.rotation_xyzw, v);
        let (ex, ey, normal) = (axis([1.0, 0.0, 0.0]), axis([0.0, 1.0, 0.0]), axis([0.0, 0.0, 1.0]));
        let o = pose.position_m;
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        // The camera must be on the printed side.
        let height = -dot(o, normal);
        if height <= 1e-6 {
            return None;
        }
        // A ray d meets the plane at o + ex u + ey v: u : v : 1 = d.(ey x o) : d.(o x ex) : d.(ex x ey), up to sign.
        let rows = [cross(ey, o), cross(o, ex), cross(ex, ey)];
        let cell = tag.side_m / CELLS as f64;
        let half = 0.5 * PRINTED as f64;
        // Columns from the left, rows from above.
        let column = add(scale(rows[0], 1.0 / cell), scale(rows[2], half));
        let row = add(scale(rows[1], -1.0 / cell), scale(rows[2], half));
        // Light from the camera's side and from everywhere.
        let facing = height / dot(o, o).sqrt();
        let light = config.white * (0.4 + 0.6 * facing);
        Some(Self { map: [column, row, rows[2]], white: light * WHITE, black: light * BLACK })
    }

    /// Column and row of the cell that the straight ray `[x, y]` (y down) meets; `None` beside the sheet.
    fn cell(&self, [x, y]: [f64; 2]) -> Option<[usize; 2]> {
        let d = |r: &[f64; 3]| r[0] * x - r[1] * y - r[2];
        let w = 1.0 / d(&self.map[2]);
        let (i, j) = (d(&self.map[0]) * w, d(&self.map[1]) * w);
        let most = PRINTED as f64;
        (i >= 0.0 && j >= 0.0 && i < most && j < most).then_some([i as usize, j as usize])
    }
}

/// A marker at an instant.
#[derive(Clone, Copy)]
struct Ball {
    middle: [f64; 3],
    radius: f64,
}

impl Ball {
    fn meets(&self, [x, y]: [f64; 2]) -> bool {
        let d = [x, -y, -1.0];
        let c = cross(d, self.middle);
        let (across, along) = (c[0] * c[0] + c[1] * c[1] + c[2] * c[2], d[0] * d[0] + d[1] * d[1] + 1.0);
        across < self.radius * self.radius * along
    }
}

/// What is painted at one instant.
#[derive(Clone, Copy)]
enum Instant {
    Plane(Plane),
    Ball(Ball),
    /// Nothing is seen of it.
    Away,
}

/// Paints a sheet over what is there.
pub(super) fn paint(
    config: &MockCameraConfig,
    grid: &[[f32; 2]],
    sheet: &Sheet<'_>,
    begin_ns: i64,
    light: &mut [f32],
) {
    let width = config.optics.size[0] as usize;
    let cells: [[bool; PRINTED]; PRINTED] = match &sheet.content {
        PaintedContent::Tag(tag) => {
            std::array::from_fn(|y| std::array::from_fn(|x| printed_cell(tag.id, x, y).unwrap_or(false)))
        }
        PaintedContent::Marker(_) => [[true; PRINTED]; PRINTED],
    };
    let mut instants = Vec::new();
    for y in sheet.rows[0]..sheet.rows[1] {
        if y == sheet.rows[0] || config.row_ns > 0 {
            instants = instants_of(config, sheet, begin_ns + config.row_ns * y as i64);
        }
        for x in sheet.columns[0]..sheet.columns[1] {
            let at = |i: usize, j: usize| grid[(y + j) * (width + 1) + x + i].map(f64::from);
            let corners = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)];
            let (sum, share) = pixel(config, &instants, &cells, &corners, y * width + x);
            if share > 0.0 {
                let there = &mut light[y * width + x];
                *there = (f64::from(*there) * (1.0 - share) + sum) as f32;
            }
        }
    }
}

/// The sheet at the instants of a row's exposure, one if nothing moves.
fn instants_of(config: &MockCameraConfig, sheet: &Sheet<'_>, begin_ns: i64) -> Vec<Instant> {
    let still = sheet.motion.pose_at(begin_ns) == sheet.motion.pose_at(begin_ns + config.exposure_ns / 3);
    let count = if still { 1 } else { i64::from(config.instants) };
    (0..count)
        .map(|i| {
            let t = begin_ns + config.exposure_ns * (2 * i + 1) / (2 * count);
            let body = in_camera(&config.pose, &sheet.motion.pose_at(t));
            match &sheet.content {
                PaintedContent::Tag(tag) => {
                    Plane::of(config, tag, &body).map_or(Instant::Away, Instant::Plane)
                }
                PaintedContent::Marker(marker) => {
                    let middle = add(body.position_m, rotate(body.rotation_xyzw, marker.middle_m));
                    Instant::Ball(Ball { middle, radius: marker.radius_m })
                }
            }
        })
        .collect()
}

/// The light of a pixel and the share of it that is covered.
fn pixel(
    config: &MockCameraConfig,
    instants: &[Instant],
    cells: &[[bool; PRINTED]; PRINTED],
    corners: &[[f64; 2]; 4],
    index: usize,
) -> (f64, f64) {
    let value = |instant: &Instant, ray: [f64; 2]| -> Option<f64> {
        match instant {
            Instant::Plane(p) => p.cell(ray).map(|[i, j]| if cells[j][i] { p.white } else { p.black }),
            Instant::Ball(b) => b.meets(ray).then_some(255.0 * MARKER),
            Instant::Away => None,
        }
    };
    let place = |instant: &Instant, ray: [f64; 2]| match instant {
        Instant::Plane(p) => p.cell(ray),
        Instant::Ball(b) => b.meets(ray).then_some([0, 0]),
        Instant::Away => None,
    };
    // Where all corners lie in one cell all the time, every sample is the same.
    let ends = [&instants[0], &instants[instants.len() - 1]];
    let first = place(ends[0], corners[0]);
    let same = ends.iter().all(|i| corners.iter().all(|c| place(i, *c) == first));
    let is_plane = matches!(ends[0], Instant::Plane(_));
    if same && (first.is_some() || instants.len() == 1 && is_plane) {
        return value(&instants[instants.len() / 2], corners[0]).map_or((0.0, 0.0), |v| (v, 1.0));
    }
    let n = config.samples as usize;
    // Which place sees which instant differs from pixel to pixel, so that blur leans to no side.
    let drawn = (index as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
    let (begin, stride) = (drawn as usize & 0xff, 2 * (drawn as usize >> 8 & 0xff) + 1);
    let rounds = instants.len().div_ceil(n * n).max(1);
    let count = n * n * rounds;
    // No two samples of a pixel lie above or beside one another, and the pattern is shifted from pixel to pixel: an edge that
    // runs along the pixels is where it is, and not at the next line of samples.
    let shift = [drawn >> 16 & 0xf, drawn >> 20 & 0xf].map(|bits| (bits as f64 + 0.5) / 16.0);
    let (mut sum, mut hits) = (0.0, 0usize);
    for k in 0..count {
        let [i, j] = [k % n, k / n % n].map(|i| i as f64);
        let instant = &instants[(begin + k * stride) % instants.len()];
        let side = n as f64;
        let [u, v] = [i + (j + shift[0]) / side, j + (i + shift[1]) / side].map(|at| at / side);
        let mix = |c: usize| {
            let upper = corners[0][c] + u * (corners[1][c] - corners[0][c]);
            let lower = corners[2][c] + u * (corners[3][c] - corners[2][c]);
            upper + v * (lower - upper)
        };
        if let Some(value) = value(instant, [mix(0), mix(1)]) {
            (sum, hits) = (sum + value, hits + 1);
        }
    }
    (sum / count as f64, hits as f64 / count as f64)
}
