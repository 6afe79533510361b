//! Pictures and charts in software: meshes seen from a camera, heat maps with legends, plots.
//!
//! In: plain slices of positions, faces and values. Out: [`image::RgbImage`], PNG bytes, SVG text; the same bytes for
//! the same input on any number of threads. Knows nothing of the stages; only [`png::write`] can fail, at the disk.
//!
//! | file | idea |
//! |---|---|
//! | `view` | cameras: from above, oblique, a flight around a box |
//! | `raster` | which face is seen at which pixel |
//! | `shade` | paint, light and 2×2 smoothing of what is seen |
//! | `scene` | textured meshes, and how alike two pictures are |
//! | `holes` | pixels where one mesh has surface and another has not |
//! | `ramp` | values and classes become colours |
//! | `text` | a bitmap font |
//! | `panel` | grids of pictures with titles and legends |
//! | `axis`, `plot` | ticks; line and bar charts |
//! | `sheet` | flat shapes as SVG or as pixels |

pub mod axis;
pub mod holes;
pub mod panel;
pub mod plot;
pub mod png;
pub mod ramp;
pub mod raster;
pub mod scene;
pub mod shade;
pub mod sheet;
pub mod text;
pub mod view;
