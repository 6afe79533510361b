//! Puts coordinates where they belong: source units to local east-north-up metres to the Earth.
//!
//! In: what the user or a file says about coordinates ([`Georeference`]). Out: a [`Frame`] between the spaces
//!
//! - `source`: a vertex as it stands in the file, in the file's units;
//! - `local`: metres east, north and up of the dataset's origin, what every later stage works in;
//! - `ecef`: metres from the Earth's centre on WGS 84, what 3D Tiles are placed in.
//!
//! # Method
//! 1. [`crs`] turns a code, WKT or proj string into a projection that leaves heights alone.
//! 2. [`frame`] takes each vertex over projection, ellipsoid and tangent plane, so that grid convergence and scale
//!    are honoured per vertex instead of once per dataset.
//!
//! # Limits
//! No grid-file shifts (NTv2, geoids): national datums without a close WGS 84 twin are as good as their Helmert
//! parameters, 1 to 5 m as a whole and far better from point to point. WGS 84, ETRS89, NAD83 and their kin are taken
//! as one.

pub mod bounds;
pub mod bvh;
pub mod convex;
pub mod crs;
pub mod eigen;
pub mod ellipsoid;
pub mod frame;
pub mod georeference;
pub mod hash;
mod wkt;

pub use bounds::{Aabb, Rect};
pub use crs::Crs;
pub use ellipsoid::Geodetic;
pub use frame::{Frame, FrameSummary};
pub use georeference::{Georeference, Vertical};
