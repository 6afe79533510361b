//! Sums up an input: what the readers found, images by their headers only.

use std::fmt;
use std::io::Cursor;

use glam::DVec3;
use serde::Serialize;

use crate::input::{ImageRef, Source};

/// What an input holds, in source coordinates.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SourceSummary {
    /// Files or primitives.
    pub parts: u64,
    /// Vertices before welding.
    pub vertices: u64,
    /// Triangles.
    pub faces: u64,
    /// Triangles with texture coordinates.
    pub textured_faces: u64,
    /// Number of materials.
    pub materials: u64,
    /// The images.
    pub images: Vec<ImageSummary>,
    /// Parts with a colour per vertex.
    pub colored_parts: u64,
    /// Labels present, with their number of faces.
    pub labels: Vec<(i16, u64)>,
    /// Lowest corner, source units; `None` without vertices.
    pub min: Option<[f64; 3]>,
    /// Highest corner, source units.
    pub max: Option<[f64; 3]>,
    /// Copyright texts.
    pub copyright: Vec<String>,
}

/// One image.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImageSummary {
    /// File or name.
    pub name: String,
    /// Width and height, pixels; `None` if the header cannot be read.
    pub size_px: Option<[u32; 2]>,
}

/// Sums up `source`. Opens image files for their headers; one that cannot be read has no size.
pub fn source(source: &Source) -> SourceSummary {
    let mut labels = std::collections::BTreeMap::<i16, u64>::new();
    source.parts.iter().flat_map(|p| &p.face_labels).for_each(|&label| *labels.entry(label).or_default() += 1);
    let points = || source.parts.iter().flat_map(|p| p.positions.iter().copied());
    let sum = |of: fn(&crate::input::Part) -> usize| source.parts.iter().map(|p| of(p) as u64).sum();
    SourceSummary {
        parts: source.parts.len() as u64,
        vertices: sum(|p| p.positions.len()),
        faces: sum(|p| p.faces.len()),
        textured_faces: sum(|p| p.corner_uvs.len()),
        materials: source.materials.len() as u64,
        images: source.images.iter().map(image).collect(),
        colored_parts: source.parts.iter().filter(|p| !p.vertex_colors.is_empty()).count() as u64,
        labels: labels.into_iter().collect(),
        min: points().reduce(DVec3::min).map(|p| p.to_array()),
        max: points().reduce(DVec3::max).map(|p| p.to_array()),
        copyright: source.copyright.clone(),
    }
}

fn image(image: &ImageRef) -> ImageSummary {
    let (name, size) = match image {
        ImageRef::File(path) => {
            let reader = image::ImageReader::open(path).and_then(|r| r.with_guessed_format());
            (path.display().to_string(), reader.ok().and_then(|r| r.into_dimensions().ok()))
        }
        ImageRef::Encoded { name, bytes } => {
            let reader = image::ImageReader::new(Cursor::new(&bytes[..])).with_guessed_format();
            (name.clone(), reader.ok().and_then(|r| r.into_dimensions().ok()))
        }
        ImageRef::Pixels(pixels) => ("pixels in memory".into(), Some(pixels.dimensions())),
    };
    ImageSummary { name, size_px: size.map(Into::into) }
}

impl fmt::Display for SourceSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} parts, {} vertices, {} faces ({} textured)",
            self.parts, self.vertices, self.faces, self.textured_faces
        )?;
        if let (Some(min), Some(max)) = (self.min, self.max) {
            let size = DVec3::from(max) - DVec3::from(min);
            writeln!(
                f,
                "from {:.2}, {:.2}, {:.2} to {:.2}, {:.2}, {:.2}",
                min[0], min[1], min[2], max[0], max[1], max[2]
            )?;
            writeln!(f, "{:.2} × {:.2} × {:.2} units", size.x, size.y, size.z)?;
        }
        writeln!(f, "{} materials, {} images", self.materials, self.images.len())?;
        for image in &self.images {
            let size = image.size_px.map_or("unreadable".into(), |[w, h]| format!("{w} × {h} px"));
            writeln!(f, "  {} {size}", image.name)?;
        }
        if self.colored_parts > 0 {
            writeln!(f, "{} parts with vertex colours", self.colored_parts)?;
        }
        for (label, faces) in &self.labels {
            writeln!(f, "label {label}: {faces} faces")?;
        }
        self.copyright.iter().try_for_each(|text| writeln!(f, "{text}"))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::input::Part;

    #[test]
    fn a_source_is_counted_over_all_parts() {
        let part = |z: f64, label| Part {
            positions: vec![DVec3::new(0.0, 0.0, z), DVec3::X, DVec3::Y],
            faces: vec![[0, 1, 2]],
            face_labels: vec![label],
            ..Default::default()
        };
        let images = vec![
            ImageRef::Pixels(Arc::new(image::RgbImage::new(4, 2))),
            ImageRef::Encoded { name: "torn.jpg".into(), bytes: Arc::from(&b"\xff\xd8\xff"[..]) },
        ];
        let summary = source(&Source { parts: vec![part(7.0, 3), part(-1.0, 3)], images, ..Default::default() });
        assert_eq!((summary.vertices, summary.faces, summary.textured_faces), (6, 2, 0));
        assert_eq!(summary.labels, [(3, 2)]);
        assert_eq!((summary.min, summary.max), (Some([0.0, 0.0, -1.0]), Some([1.0, 1.0, 7.0])));
        assert_eq!(summary.images.iter().map(|i| i.size_px).collect::<Vec<_>>(), [Some([4, 2]), None]);
        assert!(summary.to_string().contains("torn.jpg unreadable"));
        assert_eq!(source(&Source::default()).min, None);
    }
}
