//! The stages up to classes, for those who want labels and no tileset.

use std::path::{Path, PathBuf};

use super::report::{ClassShare, shares};
use crate::classes::nine::{Measures, Scene};
use crate::classes::{Classes, Ground, classify_measured, looks_at_colors};
use crate::config::Config;
use crate::geo::{Aabb, Frame, Georeference};
use crate::input::{Part, Source};
use crate::mesh::{self, GateReport, Mesh};
use crate::planes::{self, Planes};
use crate::report::Reporter;
use crate::texture::{Images, Surface, mean_colors};
use crate::{Error, Result};

/// A mesh and its planes, ready to be classified.
pub struct Front {
    /// Welded, in local metres.
    pub mesh: Mesh,
    /// What welding did.
    pub gate: GateReport,
    /// Local from source coordinates.
    pub frame: Frame,
    /// Its planar regions.
    pub planes: Planes,
    /// Mean sRGB per face; empty where nothing has colour or nobody looks at it.
    pub face_colors: Vec<[u8; 3]>,
}

impl Front {
    /// Runs the stages. Images are decoded where the labelling looks at colours, or if `shows_colors`.
    ///
    /// # Errors
    /// A source without surface or outside its coordinate system, or a wish to stop.
    pub fn of(
        source: Source,
        georeference: &Georeference,
        config: &Config,
        shows_colors: bool,
        reporter: &Reporter,
    ) -> Result<Self> {
        let refs = source.images.clone();
        let (source, frame) = place(source, georeference, reporter)?;
        let (mesh, gate) = weld(source, config, reporter)?;
        reporter.check()?;
        let stage = reporter.stage("planes", 0);
        let planes = planes::grow(&mesh, &config.planes);
        stage.finish(format!("{} regions, median edge {:.3} m", planes.regions.len(), planes.median_edge_m));
        reporter.check()?;
        let mut face_colors = Vec::new();
        if shows_colors || looks_at_colors(&config.classes, &config.classify) {
            let stage = reporter.stage("colours", 0);
            let images = Images::new(refs, reporter);
            face_colors = mean_colors(&Surface::from(&mesh), &images);
            stage.finish(format!("{} images, {} faces with a colour", images.len(), face_colors.len()));
            reporter.check()?;
        }
        Ok(Self { mesh, gate, frame, planes, face_colors })
    }

    /// What features are measured on.
    pub fn scene(&self) -> Scene<'_> {
        Scene { mesh: &self.mesh, planes: &self.planes, face_colors: &self.face_colors }
    }

    /// Areas of the faces, m².
    pub fn areas_m2(&self) -> Vec<f64> {
        (0..self.mesh.faces.len()).map(|f| 0.5 * self.mesh.cross(f).length()).collect()
    }

    /// Gives every face its probabilities, and says what the classifier cannot do.
    pub fn classify(&self, ground: &Ground, measures: &Measures, config: &Config, reporter: &Reporter) -> Classes {
        let stage = reporter.stage("classes", 0);
        warn(config, reporter);
        let classes = classify_measured(self.scene(), ground, measures, &config.classes, &config.classify);
        stage.finish(share_line(&shares(&self.mesh, &classes)));
        classes
    }
}

/// Passes on what the configured classifier is known not to do.
pub(super) fn warn(config: &Config, reporter: &Reporter) {
    for what in config.classify.warnings() {
        reporter.warn("class-unreachable", &PathBuf::from("(classifier)"), what);
    }
}

/// Mean colours of the faces where the labelling looks at them, else nothing.
pub(super) fn colors(mesh: &Mesh, images: &Images, config: &Config) -> Vec<[u8; 3]> {
    if looks_at_colors(&config.classes, &config.classify) {
        mean_colors(&Surface::from(mesh), images)
    } else {
        Vec::new()
    }
}

/// Largest extent of a model, metres: up to here differences of grid points are exact, see [`mesh::GRID_PER_M`].
const MOST_EXTENT_M: f64 = 8e6;

/// Takes positions from source coordinates to the local frame.
pub(super) fn place(mut source: Source, georeference: &Georeference, reporter: &Reporter) -> Result<(Source, Frame)> {
    let stage = reporter.stage("frame", 0);
    let bounds = surface_bounds(&source.parts);
    let path = source.parts.first().map(|p| p.path.clone()).unwrap_or_default();
    if bounds.is_empty() {
        return Err(Error::input(path, "no vertex has finite coordinates; nothing to build"));
    }
    let anchor = bounds.center().with_z(bounds.min.z).round();
    let frame = Frame::of(georeference.clone(), anchor)?;
    frame.warn(reporter, &path);
    for part in &mut source.parts {
        frame.locals_from_sources(&part.path, &mut part.positions)?;
    }
    refuse_extent(&path, &bounds, &surface_bounds(&source.parts))?;
    let size = bounds.size();
    stage.finish(format!("{:.0} × {:.0} × {:.0} units, {}", size.x, size.y, size.z, frame.describe()));
    Ok((source, frame))
}

/// Refuses a model that is too wide to be placed, by its bounds in its own and in local coordinates.
pub(super) fn refuse_extent(path: &Path, bounds: &Aabb, local: &Aabb) -> Result<()> {
    let wide_m = local.size().max_element();
    if wide_m <= MOST_EXTENT_M {
        return Ok(());
    }
    let what = format!(
        "the model is {wide_m:.1e} m wide, and up to {MOST_EXTENT_M:.0e} m can be placed; look for stray vertices between \
         {} and {}",
        bounds.min, bounds.max
    );
    Err(Error::input(path, what))
}

/// Of the surface alone: a stray vertex at (0, 0, 0) must not draw the frame away from its model.
pub(super) fn surface_bounds(parts: &[Part]) -> Aabb {
    let corners = parts.iter().flat_map(|p| p.faces.iter().flatten().map(|&v| p.positions[v as usize]));
    Aabb::of(corners.filter(|p| p.is_finite()))
}

pub(super) fn weld(source: Source, config: &Config, reporter: &Reporter) -> Result<(Mesh, GateReport)> {
    let stage = reporter.stage("mesh", 0);
    let (mesh, gate) = mesh::gate(source, &config.gate, reporter)?;
    stage.finish(gate_line(&gate));
    Ok((mesh, gate))
}

/// What the gate did, for people.
pub(super) fn gate_line(gate: &GateReport) -> String {
    let GateReport { vertices_in, vertices, faces_in, faces, degenerate, duplicate, not_finite, moved_m, .. } = gate;
    format!(
        "{vertices_in} → {vertices} vertices, {faces_in} → {faces} triangles ({degenerate} degenerate, {duplicate} \
         duplicate, {not_finite} not finite), moved by up to {:.1} mm",
        1e3 * moved_m
    )
}

/// Shares of the area, for people.
pub(super) fn share_line(shares: &[ClassShare]) -> String {
    let total: f64 = shares.iter().map(|s| s.area_m2).sum();
    let parts = shares.iter().map(|s| format!("{} {:.0} %", s.class, 100.0 * s.area_m2 / total));
    parts.collect::<Vec<_>>().join(", ")
}
