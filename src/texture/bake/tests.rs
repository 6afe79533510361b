use super::*;
use crate::input::{ImageRef, Material};
use crate::report::Reporter;
use crate::texture::chart::tests::grid;
use crate::texture::sample::bilinear;
use glam::Vec2;
use std::sync::Arc;

/// Smooth enough to be resampled, busy enough to tell places apart.
fn picture(side: u32) -> RgbImage {
    RgbImage::from_fn(side, side, |x, y| {
        let (x, y) = (f64::from(x) / 9.0, f64::from(y) / 7.0);
        Rgb([128.0 + 90.0 * x.sin(), 128.0 + 90.0 * (y + x * 0.5).cos(), 128.0 + 60.0 * (x - y).sin()].map(|c| c as u8))
    })
}

struct Scene {
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    uvs: Vec<[Vec2; 3]>,
    material: Vec<u32>,
    materials: Vec<Material>,
    bvh: Bvh,
}

impl Scene {
    /// A hilly unit square, textured from above by the given UVs.
    fn hills(n: u32, uv: impl Fn(DVec3) -> Vec2) -> Self {
        let (positions, faces) = grid(n, |x, y| 0.06 * (8.0 * x).sin() * (6.0 * y).cos());
        Self::of(positions, faces, uv)
    }

    fn of(positions: Vec<DVec3>, faces: Vec<[u32; 3]>, uv: impl Fn(DVec3) -> Vec2) -> Self {
        let uvs = faces.iter().map(|f: &[u32; 3]| f.map(|v| uv(positions[v as usize]))).collect();
        let material = vec![0; faces.len()];
        let materials = vec![Material { name: "ground".into(), base_color: [9, 8, 7], image: Some(0) }];
        let bvh = Bvh::new(&positions, &faces);
        Self { positions, faces, uvs, material, materials, bvh }
    }

    fn surface(&self) -> Surface<'_> {
        Surface {
            positions: &self.positions,
            faces: &self.faces,
            corner_uvs: &self.uvs,
            face_material: &self.material,
            vertex_colors: &[],
            materials: &self.materials,
        }
    }

    fn bake(&self, tile: &Surface, image: RgbImage, texel_m: f64, config: &TextureConfig) -> Baked {
        let reporter = Reporter::new(true);
        let mut images = Images::new(vec![ImageRef::Pixels(Arc::new(image))], &reporter);
        images.cover(&self.surface());
        bake(tile, &BakeSource { surface: self.surface(), bvh: &self.bvh }, &images, texel_m, config).unwrap()
    }
}

fn from_above(p: DVec3) -> Vec2 {
    Vec2::new(p.x as f32, 1.0 - p.y as f32)
}

fn seen(baked: &Baked, f: usize, w: [f64; 3]) -> [u8; 3] {
    let size = DVec2::new(baked.atlas.width().into(), baked.atlas.height().into());
    let uv = baked.corner_uvs[f].map(|uv| uv.as_dvec2());
    bilinear(&baked.atlas, None, (uv[0] * w[0] + uv[1] * w[1] + uv[2] * w[2]) * size, [false; 2])
}

const SPOTS: [[f64; 3]; 7] = [
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.5, 0.5, 0.0],
    [0.3, 0.3, 0.4],
    [0.7, 0.1, 0.2],
    [0.1, 0.75, 0.15],
];

/// PSNR of what the baked tile shows against `truth` of a point, dB.
fn surface_psnr(tile: &Surface, baked: &Baked, truth: impl Fn(DVec3) -> [u8; 3]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for f in 0..tile.faces.len() {
        let [a, b, c] = tile.corners(f);
        for w in SPOTS {
            let wanted = truth(a * w[0] + b * w[1] + c * w[2]);
            for (x, y) in seen(baked, f, w).into_iter().zip(wanted) {
                sum += (f64::from(x) - f64::from(y)).powi(2);
                count += 1.0;
            }
        }
    }
    10.0 * (255.0 * 255.0 * count / sum).log10()
}

#[test]
fn a_mesh_baked_onto_itself_looks_the_same() {
    let scene = Scene::hills(24, from_above);
    let image = picture(256);
    let truth = |p: DVec3| bilinear(&image, None, from_above(p).as_dvec2() * 256.0, [false; 2]);
    for samples in [1, 2] {
        let config = TextureConfig { samples, ..Default::default() };
        let baked = scene.bake(&scene.surface(), picture(256), 1.0 / 256.0, &config);
        let db = surface_psnr(&scene.surface(), &baked, truth);
        assert!(db > 36.0, "{db} dB with {samples} samples");
        assert!((1.0..1.2).contains(&(baked.texel_m * 256.0)), "{}", baked.texel_m);
    }
}

#[test]
fn a_simplified_tile_keeps_the_picture() {
    let scene = Scene::hills(48, from_above);
    let (positions, faces) = grid(6, |x, y| 0.06 * (8.0 * x).sin() * (6.0 * y).cos());
    let tile = Surface { positions: &positions, faces: &faces, ..Default::default() };
    let baked = scene.bake(&tile, picture(512), 1.0 / 128.0, &TextureConfig::default());
    let image = picture(512);
    let truth = |p: DVec3| bilinear(&image, None, from_above(p).as_dvec2() * 512.0, [false; 2]);
    let db = surface_psnr(&tile, &baked, truth);
    assert!(db > 27.0, "{db} dB");
}

/// The square in two halves that are apart in the image, on magenta.
fn apart(p: DVec3) -> Vec2 {
    let v = 0.1 + 0.8 * p.y as f32;
    if p.x < 0.5 { Vec2::new(0.05 + 0.7 * p.x as f32, v) } else { Vec2::new(0.25 + 0.7 * p.x as f32, v) }
}

#[test]
fn no_background_shines_through() {
    const MAGENTA: Rgb<u8> = Rgb([255, 0, 255]);
    let (positions, mut faces) = grid(10, |_, _| 0.0);
    faces.retain(|f| f.iter().all(|&v| v % 11 < 5) || f.iter().all(|&v| v % 11 >= 5));
    let scene = Scene::of(positions, faces, apart);
    let reporter = Reporter::new(true);
    let blank = RgbImage::from_pixel(200, 200, MAGENTA);
    let mut images = Images::new(vec![ImageRef::Pixels(Arc::new(blank.clone()))], &reporter);
    images.cover(&scene.surface());
    let mask = images.mask(0).unwrap();
    let mut image = blank;
    for (x, y, texel) in image.enumerate_pixels_mut() {
        if mask.get(x, y) {
            *texel = Rgb([30, 160, 60]);
        }
    }
    for texel_m in [0.004, 0.01, 0.03, 0.09, 0.5] {
        let baked = scene.bake(&scene.surface(), image.clone(), texel_m, &TextureConfig::default());
        assert!(baked.atlas.pixels().all(|p| *p == Rgb([30, 160, 60])), "at {texel_m} m a texel");
    }
}

#[test]
fn two_storeys_keep_their_own_pictures() {
    let (mut positions, mut faces) = grid(4, |_, _| 0.0);
    let count = positions.len() as u32;
    positions.extend(positions.clone().iter().map(|p| *p + DVec3::Z * 0.3));
    faces.extend(faces.clone().iter().map(|f| f.map(|v| v + count)));
    let uv = |p: DVec3| Vec2::new(if p.z > 0.15 { 0.9 } else { 0.1 }, 0.5);
    let scene = Scene::of(positions, faces, uv);
    let image = RgbImage::from_fn(64, 64, |x, _| if x < 32 { Rgb([250, 0, 0]) } else { Rgb([0, 0, 250]) });
    let baked = scene.bake(&scene.surface(), image, 0.02, &TextureConfig::default());
    for f in 0..scene.faces.len() {
        assert_eq!(seen(&baked, f, [0.3, 0.3, 0.4]), if f < 32 { [250, 0, 0] } else { [0, 0, 250] });
    }
}

#[test]
fn a_tile_beyond_the_edge_of_its_source_takes_the_closest_color() {
    let scene = Scene::hills(8, from_above);
    let wide: Vec<_> = scene.positions.iter().map(|p| *p * DVec3::new(1.1, 1.1, 1.0)).collect();
    let far: Vec<_> = scene.positions.iter().map(|p| *p + DVec3::X * 50.0).collect();
    for positions in [wide, far] {
        let tile = Surface { positions: &positions, faces: &scene.faces, ..Default::default() };
        let image = RgbImage::from_pixel(64, 64, Rgb([200, 100, 50]));
        let baked = scene.bake(&tile, image, 0.01, &TextureConfig::default());
        assert!(baked.atlas.pixels().all(|p| *p == Rgb([200, 100, 50])));
    }
}

#[test]
fn vertex_colors_and_plain_materials_are_baked_too() {
    let mut scene = Scene::hills(12, from_above);
    scene.uvs.clear();
    let plain = scene.bake(&scene.surface(), picture(4), 0.02, &TextureConfig::default());
    assert!(plain.atlas.pixels().all(|p| *p == Rgb([9, 8, 7])));
    let colors: Vec<_> = scene.positions.iter().map(|p| [(p.x * 255.0) as u8, (p.y * 255.0) as u8, 0]).collect();
    let source = Surface { vertex_colors: &colors, ..scene.surface() };
    let reporter = Reporter::new(true);
    let images = Images::new(Vec::new(), &reporter);
    let from = BakeSource { surface: source, bvh: &scene.bvh };
    let baked = bake(&source, &from, &images, 0.01, &TextureConfig::default()).unwrap();
    let db = surface_psnr(&source, &baked, |p| [(p.x * 255.0) as u8, (p.y * 255.0) as u8, 0]);
    assert!(db > 36.0, "{db} dB");
}

#[test]
fn an_atlas_that_does_not_fit_gets_larger_texels() {
    let scene = Scene::hills(8, from_above);
    let config = TextureConfig { max_atlas_px: 64, power_of_two: true, ..Default::default() };
    for texel_m in [0.001, 0.0, f64::NAN] {
        let baked = scene.bake(&scene.surface(), picture(256), texel_m, &config);
        assert_eq!(baked.atlas.dimensions(), (64, 64));
        assert!((0.015..0.03).contains(&baked.texel_m), "{}", baked.texel_m);
    }
}

#[test]
fn empty_and_degenerate_tiles_are_no_trouble() {
    let scene = Scene::hills(4, from_above);
    let empty = scene.bake(&Surface::default(), picture(16), 0.1, &TextureConfig::default());
    assert_eq!((empty.atlas.dimensions(), empty.texel_m), ((4, 4), 0.0));
    let tile = Surface { positions: &[DVec3::ZERO; 3], faces: &[[0, 1, 2], [0, 0, 0]], ..Default::default() };
    let point = scene.bake(&tile, picture(16), 0.1, &TextureConfig::default());
    assert!(point.corner_uvs.iter().flatten().all(|uv| uv.min_element() > 0.0 && uv.max_element() < 1.0));
    let lone = Scene::of(Vec::new(), Vec::new(), from_above);
    let grey = lone.bake(&scene.surface(), picture(16), 0.1, &TextureConfig::default());
    assert!(grey.atlas.pixels().all(|p| p.0 == GREY));
}

#[test]
fn tiles_are_the_same_for_any_number_of_threads() {
    use rayon::prelude::*;
    let scene = Scene::hills(20, from_above);
    let run = |threads: usize| {
        let reporter = Reporter::new(true);
        let refs = vec![ImageRef::Pixels(Arc::new(picture(128)))];
        // A budget so small that levels are evicted all the time.
        let mut images = Images::with_budget(refs, 1000, &reporter);
        images.cover(&scene.surface());
        let source = BakeSource { surface: scene.surface(), bvh: &scene.bvh };
        let config = TextureConfig::default();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let tile = |i: u32| {
                let texel_m = 0.01 * f64::from(1 + i / 2);
                let surface = scene.surface();
                if i.is_multiple_of(2) {
                    bake(&surface, &source, &images, texel_m, &config)
                } else {
                    super::super::repack(&surface, &images, &config)
                }
            };
            (0..8_u32).into_par_iter().map(tile).collect::<Result<Vec<_>>>().unwrap()
        })
    };
    assert!(run(1) == run(2));
}
