//! A glTF becomes triangles in the tileset's local frame.

use std::cell::Cell;
use std::ops::Range;
use std::path::Path;
#[cfg(feature = "draco")]
use std::rc::Rc;
use std::sync::Arc;

use glam::{DMat4, DVec3, Vec2};

use super::classes::{Columns, Source};
#[cfg(feature = "draco")]
use super::draco::Unpacked;
use super::gltf1::{self, Decode};
use super::old_ways;
use super::refusal::{Refusal, of_gltf, refuse};
use super::store::{Address, MAX_FILE_BYTES, Stores};
use super::textures::Images;
use crate::input::gltf::accessor::{Elements, Use};
use crate::input::gltf::data::{Data, Files, shorten};
use crate::input::gltf::material::Palette;
use crate::input::gltf::primitive::{Builder, compact, moved};
use crate::input::gltf::scene::{self, Instance};
use crate::input::gltf::schema::{Draco, Int, Primitive, Root};
use crate::input::gltf::{KNOWN_EXTENSIONS, MATERIAL_EXTENSIONS, container};
use crate::report::Reporter;
use crate::{Error, Result};

/// Triangles of one glTF of a tile.
#[derive(Debug, Clone, Default)]
pub struct TileMesh {
    /// In the tileset's local frame, metres. Finite.
    pub positions: Vec<DVec3>,
    /// Indices into `positions`. Skirts, which features with a property `skirt` of 1 are, are left out.
    pub faces: Vec<[u32; 3]>,
    /// For each position, v down; zero where a part has none; empty if no part has any.
    pub uvs: Vec<Vec2>,
    /// What is drawn at once: together they are all faces, in order.
    pub parts: Vec<Part>,
    /// The base colour images that parts refer to.
    pub textures: Vec<Texture>,
    /// `None` if no feature of the file has a class.
    pub classes: Option<FaceClasses>,
    /// Bytes of the content as stored, of the first mesh of a content; images and buffers beside it are not counted.
    pub bytes: u64,
}

/// A draw call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Part {
    /// Indices of its faces.
    pub faces: Range<usize>,
    /// Index into [`TileMesh::textures`].
    pub texture: Option<usize>,
}

/// An image, not decoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Texture {
    /// Width and height; `None` if the header cannot be read.
    pub size_px: Option<[u32; 2]>,
    /// `jpeg`, `png`, `webp`, `ktx2`, or `unknown`.
    pub format: &'static str,
    /// The file.
    pub encoded: Arc<[u8]>,
}

/// Classes of faces.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FaceClasses {
    /// Names, in the order met.
    pub names: Vec<String>,
    /// For each face an index into `names`; [`FaceClasses::NONE`] without.
    pub of_face: Vec<u16>,
}

impl FaceClasses {
    /// Of faces without a class.
    pub const NONE: u16 = u16::MAX;
}

/// A property with more values than this names things, not classes.
const MAX_CLASSES: usize = 256;

/// What a glTF is read for.
pub struct Job<'a> {
    pub stores: &'a Stores,
    /// The content's file, to which URIs are relative.
    pub at: &'a Address,
    pub local_from_tile: DMat4,
    /// From the glTF's axes to z up.
    pub z_up: DMat4,
    pub reporter: &'a Reporter,
}

impl Job<'_> {
    /// Warns about the content.
    pub fn warn(&self, code: &'static str, what: &str) {
        self.reporter.warn(code, Path::new(&self.at.path), what);
    }
}

/// Reads the glTF or GLB `bytes`, moved by `rtc_center`.
pub fn read(bytes: &[u8], rtc_center: DVec3, job: &Job<'_>) -> std::result::Result<TileMesh, Refusal> {
    let path = Path::new(&job.at.path);
    let (root, decode, bin) = match gltf1::read(bytes)? {
        Some(old) => (old.root, old.decode, old.bin),
        None => {
            let container = container::split(path, bytes, job.reporter).map_err(of_gltf)?;
            let (root, decode) = old_ways::read(container.json)?;
            (root, decode, container.bin)
        }
    };
    check(&root)?;
    let beside_bytes = Cell::new(0u64);
    let find = |uri: &str| beside(job, uri, &beside_bytes);
    let data = Data::new(path, &root, bin, Files::Given(&find));
    let center = rtc_center + root.extensions.cesium_rtc.as_ref().map_or(DVec3::ZERO, |rtc| rtc.center.into());
    let local_from_scene = job.local_from_tile * DMat4::from_translation(center) * job.z_up;
    let palette = Palette::new(&data, job.reporter);
    let builder = Builder { data: &data, palette, reporter: job.reporter, center: DVec3::ZERO, corners: 0 };
    let images = Images::new(&data, &find);
    let mut reader = Reader {
        data: &data,
        builder,
        images,
        decode: &decode,
        job,
        local_from_scene,
        columns: Columns::default(),
        mesh: TileMesh::default(),
        skirts: Vec::new(),
    };
    reader.scene().map_err(|stop| match stop {
        Stop::Gltf(error) => of_gltf(error),
        Stop::Refused(refusal) => refusal,
    })?;
    Ok(reader.finish())
}

/// Refuses versions and required extensions that are not read.
fn check(root: &Root) -> std::result::Result<(), Refusal> {
    match root.asset.version.as_deref() {
        Some(version) if version.split('.').next() == Some("2") => {}
        Some(version) => return refuse("unsupported-gltf", format!("is glTF {:?}", shorten(version))),
        None => return refuse("broken-gltf", "asset.version is missing; is this a glTF?"),
    }
    for name in &root.extensions_required {
        if name == "KHR_draco_mesh_compression" {
            if cfg!(feature = "draco") {
                continue;
            }
            return refuse_draco();
        }
        let is_known = KNOWN_EXTENSIONS.contains(&name.as_str()) || old_ways::KNOWN.contains(&name.as_str());
        if !is_known && !name.starts_with(MATERIAL_EXTENSIONS) {
            return refuse("required-extension", format!("requires the extension {:?}", shorten(name)));
        }
    }
    Ok(())
}

fn refuse_draco<T>() -> std::result::Result<T, Refusal> {
    refuse("draco", "is compressed with KHR_draco_mesh_compression; build with `--features draco` (meshopt is read)")
}

/// An attribute of a primitive, stored or decoded.
enum Column<'a> {
    Stored(Elements<'a>),
    #[cfg(feature = "draco")]
    Unpacked(Rc<Unpacked>, String),
}

impl Column<'_> {
    /// The value at `vertex`, which is below the primitive's count.
    fn get<const N: usize>(&self, vertex: u32) -> [f64; N] {
        match self {
            Self::Stored(elements) => elements.get(vertex),
            #[cfg(feature = "draco")]
            Self::Unpacked(unpacked, name) => unpacked.get(name, vertex).unwrap_or([0.0; N]),
        }
    }
}

/// A primitive's vertices and how they are joined.
struct Shape<'a> {
    faces: Vec<[u32; 3]>,
    count: u64,
    positions: Column<'a>,
    #[cfg(feature = "draco")]
    unpacked: Option<Rc<Unpacked>>,
}

/// The bytes of a file beside the content. Over all such files of a content the limit is that of one.
fn beside(job: &Job<'_>, uri: &str, read_bytes: &Cell<u64>) -> Result<Vec<u8>> {
    let fail = |refusal: Refusal| Error::input(&job.at.path, format!("{:?}: {}", shorten(uri), refusal.what));
    let at = job.stores.resolve(job.at, uri).map_err(fail)?;
    let bytes = job.stores.fetch(&at).map_err(fail)?.bytes;
    read_bytes.set(read_bytes.get().saturating_add(bytes.len() as u64));
    if read_bytes.get() > MAX_FILE_BYTES {
        return Err(fail(Refusal::new("too-large", format!("the files beside it have over {MAX_FILE_BYTES} bytes"))));
    }
    Ok(bytes)
}

/// Why reading ended.
enum Stop {
    Gltf(Error),
    Refused(Refusal),
}

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        Self::Gltf(error)
    }
}

struct Reader<'a> {
    data: &'a Data<'a>,
    builder: Builder<'a>,
    images: Images<'a>,
    decode: &'a Decode,
    job: &'a Job<'a>,
    local_from_scene: DMat4,
    columns: Columns<'a>,
    mesh: TileMesh,
    /// Faces of skirts, ascending.
    skirts: Vec<usize>,
}

impl<'a> Reader<'a> {
    fn scene(&mut self) -> std::result::Result<(), Stop> {
        let data = self.data;
        for instance in scene::instances(data, self.job.reporter)? {
            self.job.reporter.check()?;
            for primitive in &data.at(&data.root.meshes, instance.mesh, "mesh")?.primitives {
                self.add(primitive, &instance)?;
            }
        }
        Ok(())
    }

    fn add(&mut self, primitive: &Primitive, instance: &Instance) -> std::result::Result<(), Stop> {
        // One that is skipped costs a little too, or it could be repeated for ever.
        self.builder.charge(1)?;
        let mode = primitive.mode.map_or(4, |mode| mode.0);
        if mode < 4 {
            self.job.warn("skipped-primitive", "points and lines are not looked at");
            return Ok(());
        }
        let Some(&position) = primitive.attributes.get("POSITION").filter(|_| mode <= 6) else {
            self.job.warn("skipped-primitive", "a primitive without POSITION or of an unknown mode was skipped");
            return Ok(());
        };
        let shape = self.shape(primitive, mode, position)?;
        let positions = &shape.positions;
        let local_from_mesh = self.local_from_scene * instance.scene_from_mesh;
        let dequantized = self.decode.get(&position.0).and_then(|m| <&[f64; 16]>::try_from(m.as_slice()).ok());
        let local_from_stored = match dequantized {
            Some(columns) => local_from_mesh * DMat4::from_cols_array(columns),
            None => local_from_mesh,
        };
        let (used, mut kept) = compact(&shape.faces);
        let place = |&vertex: &u32| local_from_stored.transform_point3(positions.get(vertex).into());
        let first = self.mesh.positions.len();
        self.mesh.positions.extend(used.iter().map(place));
        let placed = &self.mesh.positions[first..];
        if !placed.iter().all(|p| p.is_finite()) {
            let before = kept.len();
            kept.retain(|face| face.iter().all(|&vertex| placed[vertex as usize].is_finite()));
            let lost = (before - kept.len()) as u64;
            let what = "a position is not finite; the faces that use it were dropped";
            self.job.reporter.warn_many("bad-vertex", Path::new(&self.job.at.path), lost, what);
            self.mesh.positions[first..].iter_mut().filter(|p| !p.is_finite()).for_each(|p| *p = DVec3::ZERO);
        }
        if local_from_stored.determinant() < 0.0 {
            kept.iter_mut().for_each(|face| face.swap(1, 2));
        }
        let texture = self.texture(primitive, &shape, &used, first)?;
        self.label(primitive, &shape, &used, &kept)?;
        let faces_before = self.mesh.faces.len();
        self.mesh.faces.extend(kept.iter().map(|face| face.map(|vertex| vertex + first as u32)));
        self.mesh.parts.push(Part { faces: faces_before..self.mesh.faces.len(), texture });
        Ok(())
    }

    fn shape(&mut self, primitive: &Primitive, mode: u64, position: Int) -> std::result::Result<Shape<'a>, Stop> {
        let positions = Elements::of(self.data, position, Use::Position)?;
        if let Some(packed) = primitive.extensions.draco.as_ref().filter(|_| positions.is_virtual()) {
            return self.unpack(packed);
        }
        let count = positions.count;
        let faces = self.builder.faces(primitive, mode, &positions)?;
        Ok(Shape {
            faces,
            count,
            positions: Column::Stored(positions),
            #[cfg(feature = "draco")]
            unpacked: None,
        })
    }

    #[cfg(feature = "draco")]
    fn unpack(&mut self, packed: &Draco) -> std::result::Result<Shape<'a>, Stop> {
        let mut unpacked = super::draco::unpack(self.data, packed).map_err(Stop::Refused)?;
        let faces = std::mem::take(&mut unpacked.faces);
        // Instances decode again: each is charged for.
        self.builder.charge(3 * faces.len() as u64 + u64::from(unpacked.points))?;
        let unpacked = Rc::new(unpacked);
        let positions = Column::Unpacked(unpacked.clone(), "POSITION".into());
        Ok(Shape { faces, count: unpacked.points.into(), positions, unpacked: Some(unpacked) })
    }

    #[cfg(not(feature = "draco"))]
    fn unpack(&mut self, _packed: &Draco) -> std::result::Result<Shape<'a>, Stop> {
        refuse_draco().map_err(Stop::Refused)
    }

    fn attribute(
        &self,
        primitive: &Primitive,
        shape: &Shape<'_>,
        name: &str,
        usage: Use,
    ) -> Result<Option<Column<'a>>> {
        #[cfg(feature = "draco")]
        if let Some(unpacked) = &shape.unpacked {
            let has = unpacked.points == 0 || unpacked.get::<1>(name, 0).is_some();
            return Ok(has.then(|| Column::Unpacked(unpacked.clone(), name.into())));
        }
        Ok(self.builder.attribute(primitive, name, usage, shape.count)?.map(Column::Stored))
    }

    /// The image of a primitive, and UVs of its vertices, which begin at `first`.
    fn texture(
        &mut self,
        primitive: &Primitive,
        shape: &Shape<'_>,
        used: &[u32],
        first: usize,
    ) -> Result<Option<usize>> {
        let paint = self.builder.palette.paint(primitive.material)?;
        let (_, info) = self.builder.palette.base(primitive.material)?;
        let Some((set, info)) = paint.uv_set.zip(info) else { return Ok(None) };
        let texture = match self.images.place(info) {
            Ok(texture) => texture,
            Err(error) => {
                self.job.warn("missing-texture", &of_gltf(error).what);
                None
            }
        };
        let name = format!("TEXCOORD_{set}");
        let Some(uvs) = self.attribute(primitive, shape, &name, Use::Uv)? else {
            self.job.warn("missing-uv", "a textured primitive has no texture coordinates");
            return Ok(texture);
        };
        let decode = primitive.attributes.get(&name).and_then(|accessor| self.decode.get(&accessor.0));
        let decode = decode.and_then(|m| <&[f64; 9]>::try_from(m.as_slice()).ok());
        self.mesh.uvs.resize(first, Vec2::ZERO);
        let mut bad = 0;
        self.mesh.uvs.extend(used.iter().map(|&vertex| {
            let [u, v] = uvs.get::<2>(vertex);
            let [u, v] = decode.map_or([u, v], |m| [m[0] * u + m[3] * v + m[6], m[1] * u + m[4] * v + m[7]]);
            let uv = moved([u, v], paint.transform);
            bad += u64::from(!uv.is_finite());
            if uv.is_finite() { uv } else { Vec2::ZERO }
        }));
        let what = "a texture coordinate is not finite; (0, 0) is used";
        self.job.reporter.warn_many("bad-uv", Path::new(&self.job.at.path), bad, what);
        Ok(texture)
    }

    /// Classes of the faces that are to be added.
    fn label(&mut self, primitive: &Primitive, shape: &Shape<'_>, used: &[u32], kept: &[[u32; 3]]) -> Result<()> {
        let faces = self.mesh.faces.len();
        let pad = |of_face: &mut Vec<u16>, to: usize| of_face.resize(to, FaceClasses::NONE);
        let Some(source) = Source::of(self.data, &mut self.columns, primitive) else {
            if let Some(classes) = &mut self.mesh.classes {
                pad(&mut classes.of_face, faces + kept.len());
            }
            return Ok(());
        };
        let ids = match &source.attribute {
            Some(name) => match self.attribute(primitive, shape, name, Use::FeatureId)? {
                Some(column) => used.iter().map(|&vertex| column.get::<1>(vertex)[0] as u32).collect(),
                None => {
                    self.job.warn("missing-feature-ids", "EXT_mesh_features names an attribute that is not there");
                    return Ok(());
                }
            },
            None => used.to_vec(),
        };
        let empty = || FaceClasses { names: Vec::new(), of_face: Vec::new() };
        let classes = self.mesh.classes.get_or_insert_with(empty);
        pad(&mut classes.of_face, faces);
        let mut known = std::collections::BTreeMap::new();
        for face in kept {
            let [a, b, c] = face.map(|vertex| ids[vertex as usize]);
            // Tilers that share vertices between features give two corners of three to the feature.
            let id = if b == c { b } else { a };
            if source.is_skirt(id) {
                self.skirts.push(classes.of_face.len());
            }
            let class = *known.entry(id).or_insert_with(|| {
                let Some(name) = source.name(id) else { return FaceClasses::NONE };
                let at = classes.names.iter().position(|other| *other == name).unwrap_or_else(|| {
                    // One more than allowed says that these are names of things, not of classes.
                    if classes.names.len() <= MAX_CLASSES {
                        classes.names.push(name);
                    }
                    classes.names.len() - 1
                });
                u16::try_from(at).unwrap_or(FaceClasses::NONE)
            });
            classes.of_face.push(class);
        }
        Ok(())
    }

    fn finish(mut self) -> TileMesh {
        if !self.mesh.uvs.is_empty() {
            self.mesh.uvs.resize(self.mesh.positions.len(), Vec2::ZERO);
        }
        if let Some(classes) = &mut self.mesh.classes {
            classes.of_face.resize(self.mesh.faces.len(), FaceClasses::NONE);
        }
        self.mesh.classes = self.mesh.classes.filter(|classes| (1..=MAX_CLASSES).contains(&classes.names.len()));
        self.mesh.textures = self.images.textures;
        leave_out(&mut self.mesh, &self.skirts);
        self.mesh
    }
}

/// Takes faces out of a mesh, given in ascending order. Their vertices stay: boxes have to hold what is drawn.
fn leave_out(mesh: &mut TileMesh, faces: &[usize]) {
    let before = |face: usize| faces.partition_point(|&f| f < face);
    for part in &mut mesh.parts {
        part.faces = part.faces.start - before(part.faces.start)..part.faces.end - before(part.faces.end);
    }
    let keep = |f: &usize| faces.binary_search(f).is_err();
    let kept: Vec<usize> = (0..mesh.faces.len()).filter(keep).collect();
    mesh.faces = kept.iter().map(|&f| mesh.faces[f]).collect();
    if let Some(classes) = &mut mesh.classes {
        classes.of_face = kept.iter().map(|&f| classes.of_face[f]).collect();
    }
}
