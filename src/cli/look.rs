//! Textured meshes side by side, as a flight around them shows them: `compare --views`.
//!
//! # Numbers
//! PSNR in 12 views of `simplify` at 10 % of the faces, and of VCG's texture-preserving quadric collapse (its defaults, the
//! same number of faces): a building 32.4 and 26.7 dB, a campus 33.9 and 20.7 (VCG tears it along its tiles), a house 38.2
//! and 30.2.

use std::path::Path;

use glam::{DVec3, Vec2};
use image::RgbImage;
use serde::Serialize;

use crate::draw::scene::{self, Picture, Scene};
use crate::draw::view::{View, flight};
use crate::input::{Part, Source};
use crate::report::Reporter;
use crate::texture::Images;
use crate::{Error, Result};

/// Size of a view: what a viewer's window has.
const SIZE_PX: [u32; 2] = [800, 600];

/// A mesh as it is drawn.
struct Textured {
    positions: Vec<DVec3>,
    faces: Vec<[u32; 3]>,
    corner_uvs: Vec<[Vec2; 3]>,
    face_image: Vec<Option<u32>>,
    images: Vec<RgbImage>,
}

impl Textured {
    /// # Errors
    /// [`Error::Config`] for a mesh without any texture.
    fn of(path: &Path, source: &Source, reporter: &Reporter) -> Result<Self> {
        let images = Images::new(source.images.clone(), reporter);
        let images = (0..images.len()).map(|i| (*images.mip(i as u32, 0)).clone()).collect();
        let mut all =
            Self { positions: Vec::new(), faces: Vec::new(), corner_uvs: Vec::new(), face_image: Vec::new(), images };
        source.parts.iter().for_each(|part| all.add(part, source));
        if all.face_image.iter().all(Option::is_none) {
            return Err(Error::Config(format!("--views: {} has no texture; compare without", path.display())));
        }
        Ok(all)
    }

    fn add(&mut self, part: &Part, source: &Source) {
        let first = self.positions.len() as u32;
        self.positions.extend(&part.positions);
        self.faces.extend(part.faces.iter().map(|f| f.map(|v| v + first)));
        let has_uvs = !part.corner_uvs.is_empty();
        let image = |m: &u32| source.materials.get(*m as usize).and_then(|m| m.image).filter(|_| has_uvs);
        self.face_image.extend(part.face_material.iter().map(image));
        // A part may say of no face what it is made of.
        self.face_image.resize(self.faces.len(), None);
        self.corner_uvs.extend(&part.corner_uvs);
        self.corner_uvs.resize(self.faces.len(), [Vec2::ZERO; 3]);
    }

    fn pictures(&self, views: &[View]) -> Vec<Picture> {
        let scene = Scene {
            positions: &self.positions,
            faces: &self.faces,
            corner_uvs: &self.corner_uvs,
            face_image: &self.face_image,
            images: &self.images,
        };
        views.iter().map(|view| scene::draw(view, &scene)).collect()
    }
}

/// Pictures of the reference.
pub(super) struct Looks {
    views: Vec<View>,
    pictures: Vec<Picture>,
}

/// How alike the pictures of a simplified mesh are to those of the reference.
#[derive(Debug, Serialize)]
pub(super) struct Alike {
    /// Peak signal to noise ratio of each view over the pixels that both cover, decibels; null where there are none or
    /// all are equal.
    pub psnr_db: Vec<Option<f64>>,
    /// Of their mean square over all views.
    pub all_db: Option<f64>,
    /// Share of the reference's pixels that the other one covers, too.
    pub covered: f64,
}

impl Looks {
    /// Draws the reference, `count` times.
    ///
    /// # Errors
    /// [`Error::Config`] for a mesh without any texture.
    pub fn of(path: &Path, source: &Source, count: u32, reporter: &Reporter) -> Result<Self> {
        let mesh = Textured::of(path, source, reporter)?;
        let views = flight(&mesh.positions, count, SIZE_PX);
        let pictures = mesh.pictures(&views);
        Ok(Self { views, pictures })
    }

    /// Draws another mesh from the same places; the pictures are the reference's and its own, side by side.
    ///
    /// # Errors
    /// [`Error::Config`] for a mesh without any texture.
    pub fn compare(&self, path: &Path, source: &Source, reporter: &Reporter) -> Result<(Alike, Vec<RgbImage>)> {
        let others = Textured::of(path, source, reporter)?.pictures(&self.views);
        let psnr_db: Vec<Option<f64>> =
            self.pictures.iter().zip(&others).map(|(a, b)| scene::psnr(a, b).filter(|db| db.is_finite())).collect();
        let count = |picture: &Picture| picture.covered.iter().filter(|c| **c).count();
        let both = |(a, b): (&Picture, &Picture)| a.covered.iter().zip(&b.covered).filter(|(a, b)| **a && **b).count();
        let seen: usize = self.pictures.iter().map(count).sum();
        let shared: Vec<usize> = self.pictures.iter().zip(&others).map(both).collect();
        let squares =
            psnr_db.iter().zip(&shared).map(|(db, n)| db.map_or(0.0, |db| 10f64.powf(-db / 10.0)) * *n as f64);
        let share = squares.sum::<f64>() / shared.iter().sum::<usize>() as f64;
        let alike = Alike {
            psnr_db,
            all_db: Some(-10.0 * share.log10()).filter(|db| db.is_finite()),
            covered: shared.iter().sum::<usize>() as f64 / seen.max(1) as f64,
        };
        let pairs = self.pictures.iter().zip(&others).map(|(a, b)| {
            let [width, height] = SIZE_PX;
            let mut pair = RgbImage::new(2 * width, height);
            image::imageops::replace(&mut pair, &a.pixels, 0, 0);
            image::imageops::replace(&mut pair, &b.pixels, i64::from(width), 0);
            pair
        });
        Ok((alike, pairs.collect()))
    }
}

impl std::fmt::Display for Alike {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let db = |db: &Option<f64>| db.map_or("-".into(), |db| format!("{db:.1}"));
        let each: Vec<String> = self.psnr_db.iter().map(db).collect();
        let (all, covered) = (db(&self.all_db), 100.0 * self.covered);
        write!(f, "  looks alike to {all} dB over {covered:.1} % of the pixels; by view {}", each.join(" "))
    }
}
