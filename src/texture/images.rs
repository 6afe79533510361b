//! The source's images: decoded when first needed, held within a byte budget, with mips of the used texels only.
//!
//! UVs refer to stored pixels (as photogrammetry tools and glTF have it), so EXIF orientation is not applied.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::{DVec2, Vec2};
use image::{DynamicImage, ImageDecoder, ImageReader, Limits, Rgb, RgbImage};

use super::mask::{Mask, pyramid};
use super::raster::touched;
use super::{GREY, Surface};
use crate::input::{ImageRef, jpeg};
use crate::report::Reporter;

/// Decoded texels held at most by default, bytes.
const BUDGET_BYTES: u64 = 1 << 30;
/// No image may be larger on a side: what GPUs and JPEG agree on, with room to spare.
const MAX_SIDE_PX: u32 = 32768;
/// No decoder may take more, bytes: a whole 26,000² photograph.
const MAX_ALLOC_BYTES: u64 = 2 << 30;
/// Mips from this level on are kept for good outside the budget: together 1/48 of the texels, and root tiles
/// need them of every image at once.
const PINNED_LEVEL: u32 = 3;

/// Exporters overshoot the image's border by a fraction of a texel; that is not meant as tiling.
pub(super) const UV_SLACK: f64 = 1e-4;

/// Images by index, shared between threads. Answers do not depend on what is cached.
pub struct Images<'r> {
    refs: Vec<ImageRef>,
    sizes: Vec<[u32; 2]>,
    masks: Vec<Option<Mask>>,
    decoding: Vec<Mutex<()>>,
    cache: Mutex<Cache>,
    reporter: &'r Reporter,
    /// Where the first images are decoded and held: see [`Images::view`].
    shared: Option<&'r Images<'r>>,
    /// Images that cannot be read, and why.
    faults: Mutex<BTreeMap<u32, String>>,
}

#[derive(Default)]
struct Cache {
    held: BTreeMap<(u32, u32), Held>,
    budget_bytes: u64,
    used_bytes: u64,
    clock: u64,
}

struct Held {
    level: Arc<RgbImage>,
    used_at: u64,
    /// 0 when it costs nothing to hold: pinned, or the input's own memory.
    bytes: u64,
}

impl<'r> Images<'r> {
    /// Reads the headers of all images; decodes none. Unreadable ones become 1×1 grey, with a warning.
    pub fn new(refs: Vec<ImageRef>, reporter: &'r Reporter) -> Self {
        Self::with_budget(refs, BUDGET_BYTES, reporter)
    }

    /// Like [`Images::new`], holding at most about `budget_bytes` of decoded texels between uses.
    pub fn with_budget(refs: Vec<ImageRef>, budget_bytes: u64, reporter: &'r Reporter) -> Self {
        let count = refs.len();
        let mut images = Self {
            refs,
            sizes: Vec::with_capacity(count),
            masks: (0..count).map(|_| None).collect(),
            decoding: (0..count).map(|_| Mutex::default()).collect(),
            cache: Mutex::new(Cache { budget_bytes, ..Cache::default() }),
            reporter,
            shared: None,
            faults: Mutex::default(),
        };
        for image in 0..count {
            let size = images.read_size(image).unwrap_or_else(|why| {
                images.warn(image, &why);
                [1, 1]
            });
            images.sizes.push(size);
        }
        images
    }

    /// These images and `more` after them, for one surface: with mips of its own texels, from images decoded here.
    /// It holds at most about `budget_bytes` itself.
    pub fn view<'v>(&'v self, more: Vec<ImageRef>, budget_bytes: u64) -> Images<'v> {
        let mut view = Images::with_budget(more, budget_bytes, self.reporter);
        let ours = self.len();
        view.sizes.splice(0..0, self.sizes.iter().copied());
        view.masks.splice(0..0, (0..ours).map(|_| None));
        view.decoding.splice(0..0, (0..ours).map(|_| Mutex::default()));
        view.shared = Some(self);
        view
    }

    /// Images that turned out unreadable so far, and what to say of each.
    pub fn faults(&self) -> BTreeMap<u32, String> {
        lock(&self.faults).clone()
    }

    /// Where an image comes from, for messages.
    pub fn path(&self, image: u32) -> PathBuf {
        match self.refs.get(image as usize) {
            Some(ImageRef::File(path)) => path.clone(),
            Some(ImageRef::Encoded { name, .. }) => PathBuf::from(name),
            _ => PathBuf::from("(image in memory)"),
        }
    }

    /// Number of images.
    pub fn len(&self) -> usize {
        self.sizes.len()
    }

    /// True without images.
    pub fn is_empty(&self) -> bool {
        self.sizes.is_empty()
    }

    /// Width and height in texels, from the header; 1×1 for unreadable or unknown images.
    pub fn dimensions(&self, image: u32) -> [u32; 2] {
        self.sizes.get(image as usize).copied().unwrap_or([1, 1])
    }

    /// Marks all texels the surface's triangles touch. Call it once for every part of the mesh before the first
    /// [`Images::mip`]: mips average marked texels only. An image no call has touched counts as wholly used.
    pub fn cover(&mut self, surface: &Surface) {
        for f in 0..surface.faces.len() {
            let Some(image) = surface.image(f) else { continue };
            let Some(&[width, height]) = self.sizes.get(image as usize) else { continue };
            let mask = self.masks[image as usize].get_or_insert_with(|| Mask::new(width, height));
            cover_triangle(mask, [width, height], texel_corners(&surface.corner_uvs[f], [width, height]));
        }
        // Mips made before this call averaged too few texels.
        let mut cache = lock(&self.cache);
        cache.held.clear();
        cache.used_bytes = 0;
    }

    /// Level `level` of an image: 0 is the image as stored, each further one half the size (rounded up), the mean in
    /// linear light of marked texels, others filled from around them. Levels past 1×1 are the 1×1 one.
    pub fn mip(&self, image: u32, level: u32) -> Arc<RgbImage> {
        let Some(decoding) = self.decoding.get(image as usize) else {
            return Arc::new(RgbImage::from_pixel(1, 1, Rgb(GREY)));
        };
        let [width, height] = self.dimensions(image);
        let level = level.min(width.max(height).next_power_of_two().ilog2());
        if let Some(held) = lock(&self.cache).get((image, level)) {
            return held;
        }
        // One thread decodes an image, others wait for it here and then find it.
        let _alone = lock(decoding);
        if let Some(held) = lock(&self.cache).get((image, level)) {
            return held;
        }
        let base = self.base(image);
        if level == 0 {
            return base;
        }
        let mut wanted = base.clone();
        for (made, m) in pyramid(&base, self.masks[image as usize].as_ref()).into_iter().zip(1..) {
            let made = Arc::new(made);
            let pinned = self.shared.is_none() && m >= PINNED_LEVEL;
            lock(&self.cache).insert((image, m), &made, pinned);
            if m == level {
                wanted = made;
            }
        }
        wanted
    }

    /// Level 0.
    fn base(&self, image: u32) -> Arc<RgbImage> {
        let ours = match self.shared {
            // Held by the other, or not at all: two caches would hold twice what either may.
            Some(shared) if (image as usize) < shared.len() => return shared.mip(image, 0),
            Some(shared) => image as usize - shared.len(),
            None => image as usize,
        };
        let held = lock(&self.cache).get((image, 0));
        held.unwrap_or_else(|| {
            let base = self.decode(ours, self.sizes[image as usize]);
            let free = matches!(self.refs[ours], ImageRef::Pixels(_));
            lock(&self.cache).insert((image, 0), &base, free);
            base
        })
    }

    /// The marked texels, `None` when all of them are.
    pub(super) fn mask(&self, image: u32) -> Option<&Mask> {
        self.masks.get(image as usize)?.as_ref()
    }

    /// The whole image at the size its header gave: grey when it cannot be decoded.
    fn decode(&self, image: usize, [width, height]: [u32; 2]) -> Arc<RgbImage> {
        let decoded = match &self.refs[image] {
            ImageRef::Pixels(pixels) => Ok(pixels.clone()),
            ImageRef::File(path) => open(path).and_then(decode_pixels).map(Arc::new),
            ImageRef::Encoded { bytes, .. } => decode_pixels(Cursor::new(bytes)).map(Arc::new),
        };
        decoded
            .and_then(|pixels| {
                let found = pixels.dimensions();
                if found == (width, height) { Ok(pixels) } else { Err(format!("{found:?} texels after decoding")) }
            })
            .unwrap_or_else(|why| {
                // A 1×1 image was warned about when its header was read.
                if [width, height] != [1, 1] {
                    self.warn(image, &why);
                }
                Arc::new(RgbImage::from_pixel(width, height, Rgb(GREY)))
            })
    }

    fn read_size(&self, image: usize) -> Result<[u32; 2], String> {
        let (width, height) = match &self.refs[image] {
            ImageRef::Pixels(pixels) => pixels.dimensions(),
            ImageRef::File(path) => read_size(open(path)?)?,
            ImageRef::Encoded { bytes, .. } => read_size(Cursor::new(bytes))?,
        };
        let bytes = u64::from(width) * u64::from(height) * 3;
        if width == 0 || height == 0 || width > MAX_SIDE_PX || height > MAX_SIDE_PX || bytes > MAX_ALLOC_BYTES {
            return Err(format!("{width}×{height} texels, wanted 1 to {MAX_SIDE_PX} a side and at most 2 GiB"));
        }
        Ok([width, height])
    }

    /// Warns of an image once, however often it is decoded.
    fn warn(&self, image: usize, why: &str) {
        let what = format!("cannot be decoded ({why}); its faces are painted grey: replace the image and build again");
        if lock(&self.faults).insert(image as u32, what.clone()).is_none() {
            self.reporter.warn("unreadable-texture", &self.path(image as u32), what);
        }
    }
}

impl Cache {
    fn get(&mut self, key: (u32, u32)) -> Option<Arc<RgbImage>> {
        self.clock += 1;
        let held = self.held.get_mut(&key)?;
        held.used_at = self.clock;
        Some(held.level.clone())
    }

    fn insert(&mut self, key: (u32, u32), level: &Arc<RgbImage>, free: bool) {
        self.clock += 1;
        let bytes = if free { 0 } else { level.as_raw().len() as u64 };
        let fresh = Held { level: level.clone(), used_at: self.clock, bytes };
        let old = self.held.insert(key, fresh).map_or(0, |old| old.bytes);
        self.used_bytes = self.used_bytes + bytes - old;
        while self.used_bytes > self.budget_bytes {
            let oldest = self.held.iter().filter(|(_, held)| held.bytes > 0).min_by_key(|(_, held)| held.used_at);
            let Some(oldest) = oldest.map(|(&key, _)| key) else { break };
            self.used_bytes -= self.held.remove(&oldest).map_or(0, |held| held.bytes);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn open(path: &std::path::Path) -> Result<BufReader<std::fs::File>, String> {
    std::fs::File::open(path).map(BufReader::new).map_err(|e| e.to_string())
}

/// Opens a decoder chosen by content, not by file name, with limits set before it allocates.
fn decoder<'b>(reader: impl BufRead + Seek + 'b) -> image::ImageResult<impl ImageDecoder + 'b> {
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE_PX);
    limits.max_image_height = Some(MAX_SIDE_PX);
    limits.max_alloc = Some(MAX_ALLOC_BYTES);
    let mut reader = ImageReader::new(reader).with_guessed_format()?;
    reader.limits(limits);
    reader.into_decoder()
}

fn read_size(reader: impl BufRead + Seek) -> Result<(u32, u32), String> {
    guarded(|| Ok(decoder(reader)?.dimensions()))
}

fn decode_pixels(mut reader: impl BufRead + Seek) -> Result<RgbImage, String> {
    guarded(move || {
        if reader.fill_buf()?.starts_with(&jpeg::MAGIC)
            && let Some(pixels) = jpeg::decode(&mut reader, MAX_ALLOC_BYTES as usize)
        {
            return Ok(pixels);
        }
        reader.rewind()?;
        Ok(DynamicImage::from_decoder(decoder(reader)?)?.into_rgb8())
    })
}

/// Decoders are known to panic on some broken files; that is one unreadable image, not the end of the run.
fn guarded<T>(decode: impl FnOnce() -> image::ImageResult<T>) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(decode)) {
        Ok(done) => done.map_err(|e| e.to_string()),
        Err(_) => Err("the decoder gave up".into()),
    }
}

/// Corner places in texels, shifted by whole images so that the smallest lies in the first one.
pub(super) fn texel_corners(uvs: &[Vec2; 3], size: [u32; 2]) -> [DVec2; 3] {
    let low = uvs[0].min(uvs[1]).min(uvs[2]).as_dvec2();
    let high = uvs[0].max(uvs[1]).max(uvs[2]).as_dvec2();
    let size = DVec2::new(size[0].into(), size[1].into());
    // A chart that ends at 1.0 is in the first image, not at the start of the second.
    let shift = DVec2::new(whole_images(low.x, high.x), whole_images(low.y, high.y));
    uvs.map(|uv| (uv.as_dvec2() - shift) * size)
}

/// How many whole images an interval of UVs lies beyond the first; one inside 0..=1 stays where it is.
pub(super) fn whole_images(low: f64, high: f64) -> f64 {
    if low >= -UV_SLACK && high <= 1.0 + UV_SLACK { 0.0 } else { low.floor() }
}

/// Marks what a triangle touches; one that reaches beyond the image repeats it.
fn cover_triangle(mask: &mut Mask, [width, height]: [u32; 2], corners: [DVec2; 3]) {
    let size = DVec2::new(width.into(), height.into());
    let reach = corners[0].max(corners[1]).max(corners[2]) / size;
    // More than a few repeats: it surely touches everything, and rows would be visited over and over.
    if reach.max_element() > 4.0 {
        return (0..height).for_each(|y| mask.set_span(y, 0, width));
    }
    let (w, h) = (i64::from(width), i64::from(height));
    touched(corners, |y, x0, x1| {
        let y = if reach.y <= 1.0 + UV_SLACK { y.clamp(0, h - 1) } else { y.rem_euclid(h) };
        if reach.x <= 1.0 + UV_SLACK {
            return mask.set_span(y as u32, x0.clamp(0, w - 1) as u32, x1.clamp(1, w) as u32);
        }
        let start = x0.rem_euclid(w);
        let end = start + (x1 - x0).min(w);
        mask.set_span(y as u32, start as u32, end.min(w) as u32);
        mask.set_span(y as u32, 0, (end - w).max(0) as u32);
    });
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::input::Material;

    /// Peak signal to noise ratio of two images of one size, dB.
    pub fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
        assert_eq!(a.dimensions(), b.dimensions());
        let square = |(x, y): (&u8, &u8)| f64::from(i32::from(*x) - i32::from(*y)).powi(2);
        let mse = a.as_raw().iter().zip(b.as_raw()).map(square).sum::<f64>() / a.as_raw().len() as f64;
        10.0 * (255.0 * 255.0 / mse).log10()
    }

    fn png(image: &DynamicImage) -> Arc<[u8]> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner().into()
    }

    fn encoded(name: &str, bytes: Arc<[u8]>) -> ImageRef {
        ImageRef::Encoded { name: name.into(), bytes }
    }

    #[test]
    fn grey_alpha_and_16_bit_images_become_rgb() {
        let reporter = Reporter::new(true);
        let refs = vec![
            encoded("grey", png(&DynamicImage::ImageLuma8(image::GrayImage::from_pixel(3, 2, image::Luma([7]))))),
            encoded(
                "alpha",
                png(&DynamicImage::ImageRgba8(image::RgbaImage::from_pixel(3, 2, image::Rgba([1, 2, 3, 0])))),
            ),
            encoded(
                "deep",
                png(&DynamicImage::ImageRgb16(image::ImageBuffer::from_pixel(3, 2, Rgb([257, 514, 65535])))),
            ),
        ];
        let images = Images::new(refs, &reporter);
        for (image, color) in [(0, [7, 7, 7]), (1, [1, 2, 3]), (2, [1, 2, 255])] {
            assert_eq!(images.dimensions(image), [3, 2]);
            assert_eq!(images.mip(image, 0).get_pixel(2, 1), &Rgb(color));
        }
        assert!(reporter.warnings().is_empty());
    }

    #[test]
    fn a_broken_image_is_grey_and_counted() {
        let reporter = Reporter::new(true);
        let noise = RgbImage::from_fn(64, 64, |x, y| Rgb([(x * 7) as u8, (y * 13) as u8, (x * y) as u8]));
        let whole = png(&DynamicImage::ImageRgb8(noise));
        let cut: Arc<[u8]> = whole[..whole.len() / 2].into();
        let missing = ImageRef::File("no/such/file.jpg".into());
        let images =
            Images::new(vec![encoded("text", (*b"not an image").into()), encoded("cut", cut), missing], &reporter);
        assert_eq!([0, 1, 2, 9].map(|i| images.dimensions(i)), [[1, 1], [64, 64], [1, 1], [1, 1]]);
        for image in [0, 1, 2, 9] {
            assert!(images.mip(image, 0).pixels().all(|p| p.0 == GREY));
            assert!(images.mip(image, 3).pixels().all(|p| p.0 == GREY));
        }
        let warnings = reporter.warnings();
        assert_eq!((warnings.len(), warnings[0].code, warnings[0].count), (1, "unreadable-texture", 3));
    }

    #[test]
    fn eviction_changes_no_answer() {
        let reporter = Reporter::new(true);
        let refs: Vec<_> = (0..4_u32)
            .map(|i| {
                let image = RgbImage::from_fn(40 + i, 30, |x, y| Rgb([(x * 5) as u8, (y * 8) as u8, (i * 60) as u8]));
                encoded("image", png(&DynamicImage::ImageRgb8(image)))
            })
            .collect();
        let roomy = Images::new(refs.clone(), &reporter);
        let tight = Images::with_budget(refs, 5000, &reporter);
        for (image, level) in [(0, 0), (1, 2), (0, 1), (2, 0), (3, 4), (0, 0), (1, 9), (1, 2), (2, 1)] {
            assert_eq!(roomy.mip(image, level), tight.mip(image, level));
            assert!(lock(&tight.cache).used_bytes <= 5000);
        }
    }

    #[test]
    fn mips_hold_only_texels_the_mesh_uses() {
        let reporter = Reporter::new(true);
        let image = RgbImage::from_fn(32, 32, |x, y| if x + y < 20 { Rgb([20, 40, 60]) } else { Rgb([255, 0, 255]) });
        let mut images = Images::new(vec![ImageRef::Pixels(Arc::new(image))], &reporter);
        let uv = |x: f32, y: f32| Vec2::new(x / 32.0, y / 32.0);
        let materials = [Material { name: "m".into(), base_color: GREY, image: Some(0) }];
        images.cover(&Surface {
            positions: &[Default::default(); 3],
            faces: &[[0, 1, 2]],
            corner_uvs: &[[uv(0.0, 0.0), uv(18.0, 0.0), uv(0.0, 18.0)]],
            face_material: &[0],
            materials: &materials,
            ..Default::default()
        });
        for level in 1..6 {
            assert!(images.mip(0, level).pixels().all(|p| *p == Rgb([20, 40, 60])), "level {level}");
        }
    }

    #[test]
    fn cover_wraps_tiling_uvs_and_keeps_borders_inside() {
        let marked = |corners: [[f64; 2]; 3]| {
            let mut mask = Mask::new(8, 8);
            cover_triangle(&mut mask, [8, 8], corners.map(DVec2::from));
            (0..8)
                .map(|y| (0..8).map(|x| if mask.get(x, y) { '#' } else { '.' }).collect::<String>())
                .collect::<Vec<_>>()
        };
        // A sliver that ends exactly on the right border marks nothing on the left.
        let border = marked([[6.5, 2.5], [8.0, 2.5], [8.0, 2.6]]);
        assert_eq!(border[2], "......##");
        // One that runs over it goes on at the left.
        let over = marked([[6.5, 2.5], [9.5, 2.5], [9.5, 2.6]]);
        assert_eq!(over[2], "##....##");
        assert!(marked([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0]]).iter().all(|row| row == "########"));
    }
}
