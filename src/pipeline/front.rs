//! The stages up to classes, for those who want labels and no tileset.

use std::path::PathBuf;

use crate::Result;
use crate::classes::nine::{Measures, Scene};
use crate::classes::{Classes, Ground, classify_measured, looks_at_colors};
use crate::config::Config;
use crate::geo::{Frame, Georeference};
use crate::input::Source;
use crate::mesh::{GateReport, Mesh};
use crate::planes::{self, Planes};
use crate::report::Reporter;
use crate::texture::{Images, Surface, mean_colors};

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
    /// Mean sRGB per face; empty where nothing has colour.
    pub face_colors: Vec<[u8; 3]>,
}

impl Front {
    /// Runs the stages.
    ///
    /// # Errors
    /// A source without surface or outside its coordinate system, or a wish to stop.
    pub fn of(source: Source, georeference: &Georeference, config: &Config, reporter: &Reporter) -> Result<Self> {
        let refs = source.images.clone();
        let (source, frame) = super::place(source, georeference, reporter)?;
        let (mesh, gate) = super::weld(source, config, reporter)?;
        reporter.check()?;
        let stage = reporter.stage("planes", 0);
        let planes = planes::grow(&mesh, &config.planes);
        stage.finish(format!("{} regions, median edge {:.3} m", planes.regions.len(), planes.median_edge_m));
        reporter.check()?;
        let stage = reporter.stage("colours", 0);
        let images = Images::new(refs, reporter);
        let face_colors = mean_colors(&Surface::from(&mesh), &images);
        stage.finish(format!("{} images, {} faces with a colour", images.len(), face_colors.len()));
        reporter.check()?;
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
        stage.finish(super::share_line(&super::shares(&self.mesh, &classes)));
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
