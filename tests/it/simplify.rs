//! Simplifying a textured mesh, by the program: what is written is whole and looks as the source does.
//!
//! With `ROOFTILE_PICTURES` set to a folder, the real scan's source and cut are put there side by side.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DVec3, Vec2};
use image::RgbImage;
use rooftile::draw::png;
use rooftile::draw::scene::{self, Picture, Scene};
use rooftile::draw::view::flight;
use rooftile::input::{self, InputConfig};
use rooftile::report::Reporter;
use rooftile::texture::Images;
use serde_json::Value;

use crate::common::{data, glb, names, rooftile, shapes};

/// A mesh as it is drawn.
struct Textured {
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    corner_uvs: Vec<[Vec2; 3]>,
    face_image: Vec<Option<u32>>,
    images: Vec<RgbImage>,
}

impl Textured {
    fn read(path: &Path) -> Self {
        let reporter = Reporter::new(true);
        let (source, _) = input::read(&[path.to_path_buf()], &InputConfig::default(), &reporter).expect("a mesh");
        let images = Images::new(source.images, &reporter);
        let mut all = Self {
            positions: Vec::new(),
            faces: Vec::new(),
            corner_uvs: Vec::new(),
            face_image: Vec::new(),
            images: (0..images.len()).map(|i| (*images.mip(i as u32, 0)).clone()).collect(),
        };
        for part in source.parts {
            let first = all.positions.len() as u32;
            all.positions.extend(part.positions);
            all.faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
            let has_uvs = !part.corner_uvs.is_empty();
            let image = |m: &u32| source.materials[*m as usize].image.filter(|_| has_uvs);
            all.face_image.extend(part.face_material.iter().map(image));
            all.corner_uvs.extend(if has_uvs { part.corner_uvs } else { vec![[Vec2::ZERO; 3]; part.faces.len()] });
        }
        assert!(reporter.warnings().is_empty(), "{:?}", reporter.warnings());
        all
    }

    /// Twelve pictures around the box of `of`.
    fn pictures(&self, of: &Self, size_px: [u32; 2]) -> Vec<Picture> {
        let scene = Scene {
            positions: &self.positions,
            faces: &self.faces,
            corner_uvs: &self.corner_uvs,
            face_image: &self.face_image,
            images: &self.images,
        };
        flight(&of.positions, 12, size_px).iter().map(|view| scene::draw(view, &scene)).collect()
    }
}

fn psnrs(source: &[Picture], cut: &[Picture]) -> Vec<f64> {
    source.iter().zip(cut).map(|(a, b)| scene::psnr(a, b).expect("both are seen")).collect()
}

/// Hills of 2·n² triangles under two images of soft stripes; every second row of quads takes the other image mirrored,
/// so that no texture coordinate can be carried from a face to its neighbour.
fn painted_hills(folder: &Path, n: usize) -> PathBuf {
    let path = shapes::hills(folder, n);
    let geometry = fs::read_to_string(&path).expect("a file");
    let mut text = String::from("mtllib hills.mtl\n");
    geometry.lines().filter(|l| l.starts_with('v')).for_each(|l| writeln!(text, "{l}").expect("text"));
    let part = |i: usize| i as f64 / n as f64;
    for y in 0..=n {
        for x in 0..=n {
            writeln!(text, "vt {} {}\nvt {} {}", part(x), part(y), 1.0 - part(x), part(y)).expect("text");
        }
    }
    for (i, line) in geometry.lines().filter(|l| l.starts_with('f')).enumerate() {
        let odd = (i / n) % 2;
        writeln!(text, "usemtl {}", ["even", "odd"][odd]).expect("text");
        text.push('f');
        for v in line.split_whitespace().skip(1).map(|v| v.parse::<usize>().expect("a number")) {
            write!(text, " {v}/{}", 2 * v - 1 + odd).expect("text");
        }
        text.push('\n');
    }
    fs::write(&path, text).expect("a file");
    let mtl = "newmtl even\nmap_Kd even.png\nnewmtl odd\nmap_Kd odd.png\n";
    fs::write(folder.join("hills.mtl"), mtl).expect("a file");
    let wave = |t: f64| (127.0 + 100.0 * t.sin()) as u8;
    let even = RgbImage::from_fn(256, 256, |x, y| {
        image::Rgb([wave(f64::from(x) / 6.0), wave(f64::from(y) / 9.0), wave(f64::from(x + y) / 20.0)])
    });
    even.save(folder.join("even.png")).expect("an image");
    image::imageops::flip_horizontal(&even).save(folder.join("odd.png")).expect("an image");
    path
}

fn simplify(input: &Path, out: &Path, more: &[&str]) -> Value {
    let mut args = vec!["simplify", input.to_str().expect("UTF-8"), "-o", out.to_str().expect("UTF-8"), "-q", "--json"];
    args.extend(more);
    rooftile(args).wants(0).json()
}

#[test]
fn a_cut_of_a_textured_mesh_looks_like_it() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = painted_hills(temp.path(), 40);
    let source = Textured::read(&input);
    let seen = source.pictures(&source, [160, 120]);
    for name in ["cut.glb", "out.obj"] {
        let out = temp.path().join(name);
        let report = simplify(&input, &out, &["--faces", "20%"]);
        let cut = Textured::read(&out);
        assert_eq!(report["faces"], cut.faces.len());
        assert!(cut.face_image.iter().all(Option::is_some) && cut.images.len() == 1);
        let size = [cut.images[0].width(), cut.images[0].height()];
        assert_eq!(serde_json::json!(size), report["texture"]["size_px"]);
        assert!(cut.corner_uvs.iter().flatten().all(|uv| uv.min_element() >= 0.0 && uv.max_element() <= 1.0));
        // Without paint the stripes' own deviation, 71 of 255, is left: 11 dB.
        let found = psnrs(&seen, &cut.pictures(&source, [160, 120]));
        eprintln!("{name}: {found:.1?} dB");
        assert!(found.iter().all(|p| *p > 24.0), "{name}: {found:?}");
    }
}

#[test]
fn a_preset_gives_the_budgets_that_its_name_stands_for() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = painted_hills(temp.path(), 40);
    let faces = |flags: &[&str]| {
        let args: Vec<&str> = ["--scale", "1", "--no-texture"].iter().chain(flags).copied().collect();
        simplify(&input, &temp.path().join("cut.ply"), &args)["faces"].as_u64().expect("a count")
    };
    let city = faces(&["--preset", "city"]);
    assert_eq!(city, faces(&["--budget", "roof=0.05,facade=0.05,terrain=0.2,clutter=0.2"]));
    assert!(city < faces(&[]), "terrain may move further than by default: {city}");
    assert!(faces(&["--preset", "city", "--budget", "terrain=0.02"]) > city, "what is named comes over the preset");
}

#[test]
fn compare_draws_both_and_says_how_alike_they_look() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = painted_hills(temp.path(), 24);
    let [out, plain, folder] = ["cut.glb", "plain.ply", "look"].map(|name| temp.path().join(name));
    simplify(&input, &out, &["--faces", "20%"]);
    simplify(&input, &plain, &["--faces", "20%"]);
    let compare = |simplified: &Path| {
        let [input, simplified, folder] = [&input, simplified, &folder].map(|p| p.to_str().expect("UTF-8"));
        let fixed = ["compare", input, simplified, "-q", "--json", "--samples", "1000", "--views", "3", "--pictures"];
        rooftile(fixed.into_iter().chain([folder]))
    };
    let alike = compare(&out).wants(0).json()["simplified"][0]["alike"].clone();
    let each: Vec<f64> = alike["psnr_db"].as_array().expect("views").iter().map(|v| v.as_f64().expect("dB")).collect();
    assert!(each.len() == 3 && each.iter().all(|db| *db > 24.0), "{alike}");
    let all = alike["all_db"].as_f64().expect("dB");
    assert!(each.iter().any(|db| *db <= all) && each.iter().any(|db| *db >= all), "{alike}");
    assert!(alike["covered"].as_f64().is_some_and(|share| share > 0.98 && share <= 1.0), "{alike}");
    assert_eq!(names(&folder), ["0-00.png", "0-01.png", "0-02.png"]);
    let pair = image::open(folder.join("0-00.png")).expect("a picture");
    assert_eq!([pair.width(), pair.height()], [1600, 600]);
    fs::remove_dir_all(&folder).expect("a folder");
    assert!(compare(&plain).wants(2).stderr.contains("has no texture"));
    assert!(!folder.exists());
}

#[test]
fn a_glb_holds_its_picture_and_is_unlit() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = shapes::house(temp.path());
    let out = temp.path().join("cut.glb");
    simplify(&input, &out, &["--faces", "20"]);
    let tile = glb::read(&fs::read(&out).expect("a file"));
    let json = &tile.json;
    assert_eq!(json["images"].as_array().map(Vec::len), Some(1));
    assert_eq!(json["images"][0]["mimeType"], "image/jpeg");
    assert!(json["images"][0]["bufferView"].is_u64() && json["images"][0]["uri"].is_null());
    assert!(json["materials"][0]["extensions"]["KHR_materials_unlit"].is_object());
    assert!(json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"].is_u64());
    assert!(tile.faces.len() <= 20 && !tile.faces.is_empty());
}

#[test]
fn texture_can_be_limited_or_left_out_and_a_ply_has_none() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = painted_hills(temp.path(), 16);
    let out = temp.path().join("cut.glb");
    let report = simplify(&input, &out, &["--faces", "50%", "--texture-size", "64"]);
    let size = report["texture"]["size_px"].as_array().expect("a size");
    assert!(size.iter().all(|s| s.as_u64().expect("texels") <= 64));
    let before = names(temp.path());
    for (name, flags) in [("cut.glb", &["--faces", "50%", "--no-texture"][..]), ("cut.ply", &["--faces", "50%"])] {
        let out = temp.path().join(name);
        let report = simplify(&input, &out, flags);
        assert!(report["texture"].is_null());
        assert!(Textured::read(&out).images.is_empty(), "{name}");
    }
    simplify(&input, &temp.path().join("plain.obj"), &["--faces", "50%", "--no-texture"]);
    let mut after = before.clone();
    after.extend(["cut.ply".to_owned(), "plain.obj".to_owned()]);
    after.sort();
    assert_eq!(names(temp.path()), after, "no material or picture beside them");
}

#[test]
fn the_set_of_an_obj_appears_whole_or_not_at_all() {
    let temp = tempfile::tempdir().expect("a folder");
    let input = painted_hills(temp.path(), 16);
    let folder = temp.path().join("out");
    fs::create_dir(&folder).expect("a folder");
    simplify(&input, &folder.join("a.obj"), &["--faces", "50%"]);
    assert_eq!(names(&folder), ["a.jpg", "a.mtl", "a.obj"]);
    let first = fs::read(folder.join("a.obj")).expect("a file");
    simplify(&input, &folder.join("a.obj"), &["--faces", "50%", "--threads", "1"]);
    assert_eq!(fs::read(folder.join("a.obj")).expect("a file"), first, "replaced, by the same bytes");
    // A picture of somebody else's name stays, and nothing is written beside it.
    fs::write(folder.join("b.jpg"), b"mine").expect("a file");
    let [from, to] = [input, folder.join("b.obj")].map(|p| p.to_str().expect("UTF-8").to_owned());
    let run = rooftile(["simplify", &from, "-o", &to, "-q", "--faces", "50%"]).wants(5);
    assert!(run.stderr.contains("b.jpg") && run.stderr.contains("name another output"), "{}", run.stderr);
    assert_eq!(names(&folder), ["a.jpg", "a.mtl", "a.obj", "b.jpg"]);
    assert_eq!(fs::read(folder.join("b.jpg")).expect("a file"), b"mine");
}

#[test]
fn a_real_building_keeps_its_look_at_a_tenth_of_its_triangles() {
    let Some(input) = data("dthfc-building").map(|folder| folder.join("dthfc.obj")) else { return };
    let temp = tempfile::tempdir().expect("a folder");
    let out = temp.path().join("cut.glb");
    let report = simplify(&input, &out, &["--faces", "10%"]);
    eprintln!("{} of {} triangles, texture {}", report["faces"], report["source_faces"], report["texture"]);
    let (source, cut) = (Textured::read(&input), Textured::read(&out));
    let (seen, again) = (source.pictures(&source, [800, 600]), cut.pictures(&source, [800, 600]));
    let found = psnrs(&seen, &again);
    eprintln!("PSNR in 12 views: {found:.1?} dB, mean {:.2}", found.iter().sum::<f64>() / 12.0);
    if let Some(folder) = std::env::var_os("ROOFTILE_PICTURES").map(PathBuf::from) {
        for (i, (a, b)) in seen.iter().zip(&again).enumerate() {
            let mut both = RgbImage::new(1600, 600);
            image::imageops::replace(&mut both, &a.pixels, 0, 0);
            image::imageops::replace(&mut both, &b.pixels, 800, 0);
            png::write(&both, &folder.join(format!("look-{i:02}.png"))).expect("a picture");
        }
    }
    assert!(found.iter().all(|p| *p > 15.0), "{found:?}");
}
