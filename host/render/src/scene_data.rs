//! A scene into the flat arrays that the shaders read: BVHs, vertices, materials, texels, lights and the environment.

mod lights;
mod materials;
mod relight;

use super::body_tree::FEWEST_BODIES;
use super::deforming_body::DeformingBody;
use super::live_textures::{LiveTexture, PLACES};
pub use super::scene_needs::SceneNeeds;
use crate::gpu::BodyTriangles;
use crate::walker::WideTree;
use bytemuck::Zeroable;
use dpm_scene::bvh::BodyBvh;
use dpm_scene::horizon::{kept_horizons, Horizon, CLOSED};
use dpm_scene::mesh::MAX_COORDINATE_M;
use dpm_scene::{picture_at, LinearTexel, Scene, ToLinear, TriangleMesh, Wrap};
use dpm_shaders::structs::{self as gpu, AlbedoCell, Light, Material, TextureInfo, TriangleRef, Vertex};
use glam::{DAffine3, Vec3};
use std::sync::OnceLock;

/// Most bodies that a scene may have, those that never move included. The number of a body has 8 bits of a word that it shares with the triangle.
pub const MAX_BODIES: usize = 256;

/// Where the data of one body are, and its bounds in body space.
#[derive(Clone, Debug)]
pub struct BodyData {
    /// First node.
    pub node_offset: u32,
    /// First triangle.
    pub triangle_offset: u32,
    /// Lower corner, body space.
    pub bounds_min: Vec3,
    /// Upper corner, body space.
    pub bounds_max: Vec3,
    /// `INSTANCE_*`.
    pub flags: u32,
    /// Largest magnitude among coordinates.
    pub extent: f32,
}

/// The rows of an affine map for the shaders.
pub(crate) fn rows(m: &DAffine3) -> dpm_shaders::structs::Rows {
    let r = m.matrix3.transpose();
    let t = m.translation;
    [
        [r.x_axis.x as f32, r.x_axis.y as f32, r.x_axis.z as f32, t.x as f32],
        [r.y_axis.x as f32, r.y_axis.y as f32, r.y_axis.z as f32, t.y as f32],
        [r.z_axis.x as f32, r.z_axis.y as f32, r.z_axis.z as f32, t.z as f32],
    ]
}

#[cfg(test)]
impl BodyData {
    /// A box of 20 cm about its origin that the projector lights.
    pub(super) fn of_20_cm() -> Self {
        let half = 0.1;
        Self {
            node_offset: 0,
            triangle_offset: 0,
            bounds_min: Vec3::splat(-half),
            bounds_max: Vec3::splat(half),
            flags: dpm_shaders::structs::INSTANCE_PROJECTED,
            extent: half,
        }
    }
}

/// A texture that shows pictures one after the other.
#[derive(Clone, Debug)]
pub struct Clip {
    /// Index among the textures.
    pub(super) texture: usize,
    /// When each picture ends, as [`dpm_scene::Texture::ends_ns`].
    ends_ns: Vec<i64>,
    /// The first texel of each.
    offsets: Vec<u32>,
}

impl Clip {
    /// The first texel of the picture that is shown at `t_ns`.
    pub(super) fn offset_at(&self, t_ns: i64) -> u32 {
        self.offsets[picture_at(&self.ends_ns, t_ns)]
    }
}

/// A scene ready for upload.
#[derive(Clone, Debug, Default)]
pub struct SceneData {
    /// One entry per body of the scene.
    pub bodies: Vec<BodyData>,
    /// The bodies that deform.
    pub deforming: Vec<DeformingBody>,
    /// BVH nodes, five words each.
    pub nodes: Vec<[u32; 4]>,
    /// Three rows per triangle in BVH order: each is a corner as f32 bits, and a word of a horizon that tells nothing.
    pub triangles: Vec<[u32; 4]>,
    /// The horizons of the triangles, once they were asked for.
    horizons: OnceLock<Vec<Horizon>>,
    /// The trees of the bodies as the host walks them, once they were asked for.
    wide_trees: OnceLock<Vec<WideTree>>,
    /// Indices and material per triangle in BVH order.
    pub refs: Vec<TriangleRef>,
    /// All vertices.
    pub vertices: Vec<Vertex>,
    /// All materials.
    pub materials: Vec<Material>,
    /// All textures; clips with their first pictures.
    pub textures: Vec<TextureInfo>,
    /// The textures that show pictures one after the other.
    pub clips: Vec<Clip>,
    /// The textures that show what another program makes.
    pub live: Vec<LiveTexture>,
    /// The texels of all textures, and then the places of the live ones.
    pub texels: Vec<LinearTexel>,
    /// Emissive triangles and punctual lights with their alias table.
    pub lights: Vec<Light>,
    /// The strongest of them, all triangles of a body as one: what histories are relit by.
    pub lamps: Vec<Light>,
    /// About the mean radiance of what shines on a surface, as luminance; 1 where nothing does.
    pub mean_light: f32,
    /// Texels of the map with the conditional cdf, then the marginal cdf.
    pub environment: Vec<[f32; 4]>,
    /// The map filtered by the lobes of materials: what histories are relit by. Empty if the environment is constant.
    pub filtered_sky: Vec<[f32; 4]>,
    /// Width and height of the map; 0 if the environment is constant.
    pub environment_size: [u32; 2],
    /// Constant radiance.
    pub environment_constant: Vec3,
    /// Rotation about +Y.
    pub environment_rotation: f32,
    /// Probability that a light sample goes to the environment.
    pub environment_select: f32,
    /// Tables of directional albedo.
    pub albedo: Vec<AlbedoCell>,
    /// What the scene needs.
    pub needs: SceneNeeds,
    /// Levels of nodes of the deepest body.
    pub levels: u32,
}

/// What is kept although nothing needs it. This measures what leaving it out saves. No pixel may change.
#[derive(Clone, Copy, Debug, Default)]
pub struct Keep {
    /// Code of the tracer.
    pub needs: SceneNeeds,
    /// The pass that decides shading rates, for methods with a history. Nothing reads its rates.
    pub rate_map: bool,
    /// The tiles that no body touches.
    pub every_tile: bool,
    /// The rays of method dpm to pixels that were not lit in the last frame, nor near a lit pixel. With them a surface that another body's motion
    /// uncovers there is lit up to three frames earlier.
    pub every_pixel: bool,
    /// Tables in storage buffers, as on a GPU, where software Vulkan would read texel buffers.
    pub storage_tables: bool,
    /// Rays that ask each body, however many there are. This measures what the tree over bodies saves.
    pub body_list: bool,
}

/// Why a scene cannot be drawn.
#[derive(Debug, thiserror::Error)]
pub enum SceneDataError {
    /// There are too many bodies.
    #[error("the scene has {tracked} tracked bodies, {parts} parts that an animation moves, and {fixed} bodies that never move (what no body \
             claims, lamps); all together may be {MAX_BODIES}. Name fewer in scene.bodies: what is not named is one body that never \
             moves. scene.animation = \"none\" moves no part")]
    TooManyBodies {
        /// Bodies that the rig file names.
        tracked: usize,
        /// Parts that move by themselves.
        parts: usize,
        /// The others.
        fixed: usize,
    },
    /// A body has more triangles than its index can count.
    #[error("body \"{0}\" has {1} triangles; at most 16 million fit. Simplify it")]
    TooManyTriangles(String, usize),
    /// A vertex is too far away for f32.
    #[error("body \"{0}\" has a vertex at {1} m; coordinates are finite and at most {MAX_COORDINATE_M:e} m. Check the file's unit")]
    TooFar(String, f32),
}

/// Largest radiance or intensity that is uploaded. Its square times any number of samples is far below the largest f32, and it is far above what
/// any projector can show.
const BRIGHTEST: f32 = 1e12;

fn bounded(light: Vec3) -> Vec3 {
    light.min(Vec3::splat(BRIGHTEST))
}

fn luminance(c: Vec3) -> f32 {
    c.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

impl SceneData {
    /// Flattens `scene`; builds one BVH per body.
    ///
    /// # Errors
    /// There are more bodies or triangles than the packed hit record can name, or a vertex is too far away.
    pub fn build(scene: &Scene) -> Result<Self, SceneDataError> {
        let mut data = Self::default();
        if scene.bodies.len() > MAX_BODIES {
            let parts = scene.bodies.iter().filter(|b| b.motion.is_some()).count();
            let tracked = scene.bodies.iter().filter(|b| b.tracked.is_some() && b.motion.is_none()).count();
            let fixed = scene.bodies.len() - tracked - parts;
            return Err(SceneDataError::TooManyBodies { tracked, parts, fixed });
        }
        data.add_textures(scene);
        data.add_materials(scene);
        let mut powers = Vec::new();
        for (i, body) in scene.bodies.iter().enumerate() {
            data.add_body(scene, i, body, &mut powers)?;
        }
        let has_surface = |body: &&BodyData| body.flags & gpu::INSTANCE_EMPTY == 0;
        data.needs.body_tree = data.bodies.iter().filter(has_surface).count() >= FEWEST_BODIES;
        let radius = data.scene_radius(scene);
        data.add_punctual(scene, radius, &mut powers);
        let light_power: f32 = powers.iter().sum();
        data.add_environment(scene, radius, light_power);
        data.make_alias_table(&powers);
        data.add_lamps(radius, &powers);
        Ok(data)
    }

    fn add_textures(&mut self, scene: &Scene) {
        for (index, t) in scene.textures.iter().enumerate() {
            if !t.ends_ns.is_empty() {
                let first = self.texels.len();
                let offsets = (0..t.ends_ns.len()).map(|k| (first + k * t.picture_len()) as u32).collect();
                self.clips.push(Clip { texture: index, ends_ns: t.ends_ns.clone(), offsets });
            }
            let wrap = |w: Wrap| w as u32;
            self.textures.push(TextureInfo {
                offset: self.texels.len() as u32,
                width: t.width,
                height: t.height,
                flags: wrap(t.wrap_u)
                    | (wrap(t.wrap_v) << 2)
                    | (u32::from(t.srgb) << 4)
                    | (u32::from(t.nearest) << 5),
            });
            let to_linear = ToLinear::new(t.srgb);
            self.texels.extend(t.texels.iter().map(|texel| to_linear.texel(*texel)));
        }
        for live in &scene.live {
            let index = live.texture as usize;
            let t = &scene.textures[index];
            let (len, end) = (t.picture_len(), self.texels.len());
            let later = (0..PLACES - 1).map(|k| (end + k * len) as u32);
            let places = std::iter::once(self.textures[index].offset).chain(later).collect();
            self.live.push(LiveTexture { texture: index, places, len, pictures: live.pictures.clone() });
            // What is shown first is in the texture's own place.
            self.texels.resize(end + (PLACES - 1) * len, [0; 2]);
        }
    }

    fn add_body(
        &mut self,
        scene: &Scene,
        index: usize,
        body: &dpm_scene::Body,
        powers: &mut Vec<f32>,
    ) -> Result<(), SceneDataError> {
        let mesh = &body.mesh;
        let far = mesh
            .positions
            .iter()
            .flat_map(|p| p.to_array())
            .find(|v| v.is_nan() || v.abs() > MAX_COORDINATE_M);
        if let Some(far) = far {
            return Err(SceneDataError::TooFar(body.name.clone(), far));
        }
        let bvh = BodyBvh::build(mesh);
        if bvh.order.len() >= 1 << 24 {
            return Err(SceneDataError::TooManyTriangles(body.name.clone(), bvh.order.len()));
        }
        self.bodies.push(self.body_data(body));
        let vertex_base = self.vertices.len() as u32;
        self.vertices.extend((0..mesh.positions.len()).map(|i| Vertex {
            normal: mesh.normals[i].into(),
            uv: mesh.uvs[i].into(),
            tangent: mesh.tangents[i].into(),
            reserved: [0; 3],
        }));
        if let Some(deforms) = body.deforms.as_ref().filter(|_| !mesh.triangles.is_empty()) {
            let first = [self.nodes.len() / 5, self.refs.len(), vertex_base as usize];
            let vertices = mesh.positions.len();
            self.deforming.push(DeformingBody::new((index, deforms, &bvh), first, vertices));
        }
        self.add_triangles(scene, index, mesh, &bvh, vertex_base, powers);
        self.nodes.extend_from_slice(&bvh.nodes);
        self.levels = self.levels.max(bvh.levels() as u32);
        Ok(())
    }

    /// Where the data of a body that comes next will lie, and its bounds.
    fn body_data(&self, body: &dpm_scene::Body) -> BodyData {
        let mesh = &body.mesh;
        let mut flags = 0;
        if body.projected {
            flags |= gpu::INSTANCE_PROJECTED;
        }
        if mesh.triangles.is_empty() {
            flags |= gpu::INSTANCE_EMPTY;
        }
        let (mut lower, mut upper) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for p in &mesh.positions {
            lower = lower.min(*p);
            upper = upper.max(*p);
        }
        if mesh.positions.is_empty() {
            (lower, upper) = (Vec3::ZERO, Vec3::ZERO);
        }
        BodyData {
            node_offset: (self.nodes.len() / 5) as u32,
            triangle_offset: self.refs.len() as u32,
            bounds_min: lower,
            bounds_max: upper,
            flags,
            extent: lower.abs().max(upper.abs()).max_element(),
        }
    }

    /// Triangles in the order of the tree. Those that emit light become lights, with their power in `powers`.
    fn add_triangles(
        &mut self,
        scene: &Scene,
        index: usize,
        mesh: &TriangleMesh,
        bvh: &BodyBvh,
        vertex_base: u32,
        powers: &mut Vec<f32>,
    ) {
        let mut emitter_of = std::collections::HashMap::new();
        for (place, &t) in bvh.order.iter().enumerate() {
            let corners = mesh.triangles[t as usize];
            let p = corners.map(|v| mesh.positions[v as usize]);
            let rows = p.iter().zip(CLOSED);
            self.triangles
                .extend(rows.map(|(p, closed)| [p.x.to_bits(), p.y.to_bits(), p.z.to_bits(), closed]));
            let material = mesh.materials[t as usize];
            let m = &scene.materials[material as usize];
            let mut light = gpu::NO_LIGHT;
            if m.emissive.max_element() > 0.0 {
                // A triangle that is in several places of the tree is one light.
                light = *emitter_of.entry(t).or_insert_with(|| {
                    let sides = if m.double_sided { 2.0 } else { 1.0 };
                    let area = 0.5 * (p[1] - p[0]).cross(p[2] - p[0]).length();
                    powers.push(std::f32::consts::PI * area * sides * luminance(bounded(m.emissive)));
                    self.lights.push(Light {
                        kind: gpu::LIGHT_TRIANGLE,
                        instance: index as u32,
                        triangle: place as u32,
                        ..Light::zeroed()
                    });
                    self.needs.emissive = true;
                    (self.lights.len() - 1) as u32
                });
            }
            self.refs.push(TriangleRef {
                vertices: corners.map(|v| v + vertex_base),
                material,
                light,
                reserved: [0; 3],
            });
        }
    }

    /// Radius around the origin within which all bodies are at rest.
    fn scene_radius(&self, scene: &Scene) -> f32 {
        let mut radius = 0.0f64;
        for (body, data) in scene.bodies.iter().zip(&self.bodies) {
            let (lower, upper) = world_bounds(&body.world_from_body_rest, data.bounds_min, data.bounds_max);
            radius = radius.max(lower.abs().max(upper.abs()).length());
        }
        radius as f32
    }
}

impl SceneData {
    /// The tree of each body for rays that the host walks; unpacked when they are first asked for.
    pub(crate) fn wide_trees(&self) -> &[WideTree] {
        self.wide_trees.get_or_init(|| {
            let ends =
                self.bodies.iter().skip(1).map(|b| 5 * b.node_offset as usize).chain([self.nodes.len()]);
            let of_body = |(body, end): (&BodyData, usize)| {
                let row = |at: usize| {
                    let [x, y, z, _] = self.triangles[3 * body.triangle_offset as usize + at];
                    [x, y, z].map(f32::from_bits)
                };
                let corners = |at: usize| [row(3 * at), row(3 * at + 1), row(3 * at + 2)];
                WideTree::new(&self.nodes[5 * body.node_offset as usize..end], corners)
            };
            self.bodies.iter().zip(ends).map(of_body).collect()
        })
    }

    /// [`Self::triangles`] with their horizons. When they are first asked for, those that are not kept on disk take a fiftieth of a millisecond of a core
    /// for each triangle.
    pub fn triangles_with_horizons(&self) -> Vec<[u32; 4]> {
        let corner = |row: &[u32; 4]| Vec3::from_array([row[0], row[1], row[2]].map(f32::from_bits));
        let horizons = self.horizons.get_or_init(|| {
            let mut all: Vec<Horizon> = Vec::with_capacity(self.refs.len());
            let bodies = self.triangles_of_bodies();
            let rows = |i: usize| {
                let range = &bodies[i].range;
                &self.triangles[3 * range.start as usize..3 * range.end as usize]
            };
            let deforms = |i: usize| self.deforming.iter().any(|deforming| deforming.body == i);
            for (i, body) in bodies.iter().enumerate() {
                if deforms(i) {
                    all.extend(vec![CLOSED; body.range.len()]);
                } else if let Some(same) = (0..i).find(|&other| !deforms(other) && rows(other) == rows(i)) {
                    let range = &bodies[same].range;
                    all.extend_from_within(range.start as usize..range.end as usize);
                } else {
                    let triangles =
                        rows(i).chunks_exact(3).map(|t| [corner(&t[0]), corner(&t[1]), corner(&t[2])]);
                    all.extend(kept_horizons(&triangles.collect::<Vec<_>>()));
                }
            }
            all
        });
        let words = horizons.iter().flatten();
        self.triangles.iter().zip(words).map(|(row, &word)| [row[0], row[1], row[2], word]).collect()
    }

    /// The triangles of each body, and whether shaders must look for holes in them.
    pub(crate) fn triangles_of_bodies(&self) -> Vec<BodyTriangles> {
        let ends = self.bodies.iter().skip(1).map(|next| next.triangle_offset);
        let ends = ends.chain([self.refs.len() as u32]);
        let has_hole = |t: &TriangleRef| self.materials[t.material as usize].alpha_cutoff >= 0.0;
        (self.bodies.iter().zip(ends))
            .map(|(body, end)| {
                let range = body.triangle_offset..end;
                let refs = &self.refs[range.start as usize..range.end as usize];
                BodyTriangles { range, has_holes: refs.iter().any(has_hole) }
            })
            .collect()
    }
}

/// Bounds of a body after a rigid transform.
pub(crate) fn world_bounds(
    world_from_body: &DAffine3,
    lower: Vec3,
    upper: Vec3,
) -> (glam::DVec3, glam::DVec3) {
    let centre = ((lower + upper) * 0.5).as_dvec3();
    let half = ((upper - lower) * 0.5).as_dvec3();
    let m = world_from_body.matrix3;
    let c = world_from_body.transform_point3(centre);
    let h = m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
    (c - h, c + h)
}
