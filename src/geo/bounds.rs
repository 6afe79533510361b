//! Axis-aligned boxes in space and in plan.

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A box along the axes; empty while `min` exceeds `max`. NaN coordinates are never taken up.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Aabb {
    /// Least corner.
    pub min: DVec3,
    /// Greatest corner.
    pub max: DVec3,
}

impl Default for Aabb {
    fn default() -> Self {
        Self::EMPTY
    }
}

impl Aabb {
    /// Holds nothing; the neutral element of [`Aabb::union`].
    pub const EMPTY: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    /// The smallest box around `points`.
    pub fn of(points: impl IntoIterator<Item = DVec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, |mut aabb, point| {
            aabb.extend(point);
            aabb
        })
    }

    /// Grows to hold `point`.
    pub fn extend(&mut self, point: DVec3) {
        // f64::min and f64::max drop a NaN; glam's vector forms need not.
        self.min = DVec3::new(point.x.min(self.min.x), point.y.min(self.min.y), point.z.min(self.min.z));
        self.max = DVec3::new(point.x.max(self.max.x), point.y.max(self.max.y), point.z.max(self.max.z));
    }

    /// The smallest box around both.
    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// True when nothing was taken up.
    pub fn is_empty(&self) -> bool {
        !self.min.cmple(self.max).all()
    }

    /// True when `point` lies inside or at most `tolerance` (same unit) outside.
    pub fn contains(&self, point: DVec3, tolerance: f64) -> bool {
        point.cmpge(self.min - tolerance).all() && point.cmple(self.max + tolerance).all()
    }

    /// True when `other` lies inside or at most `tolerance` outside; an empty box lies in every box.
    pub fn contains_box(&self, other: &Self, tolerance: f64) -> bool {
        other.is_empty() || (self.contains(other.min, tolerance) && self.contains(other.max, tolerance))
    }

    /// Edge lengths; zero when empty.
    pub fn size(&self) -> DVec3 {
        if self.is_empty() { DVec3::ZERO } else { self.max - self.min }
    }

    /// The middle; zero when empty.
    pub fn center(&self) -> DVec3 {
        // Halves first, so that boxes near the end of f64's range do not overflow.
        if self.is_empty() { DVec3::ZERO } else { self.min * 0.5 + self.max * 0.5 }
    }

    /// The shadow on the plan.
    pub fn plan(&self) -> Rect {
        Rect { min: self.min.truncate(), max: self.max.truncate() }
    }
}

/// A rectangle in plan (x east, y north); empty while `min` exceeds `max`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rect {
    /// South-west corner.
    pub min: DVec2,
    /// North-east corner.
    pub max: DVec2,
}

impl Rect {
    /// Holds nothing.
    pub const EMPTY: Self = Self { min: DVec2::INFINITY, max: DVec2::NEG_INFINITY };

    /// True when nothing is inside.
    pub fn is_empty(&self) -> bool {
        !self.min.cmple(self.max).all()
    }

    /// True when `point` lies inside or at most `tolerance` outside.
    pub fn contains(&self, point: DVec2, tolerance: f64) -> bool {
        point.cmpge(self.min - tolerance).all() && point.cmple(self.max + tolerance).all()
    }

    /// The same rectangle elsewhere.
    pub fn moved(&self, by: DVec2) -> Self {
        Self { min: self.min + by, max: self.max + by }
    }

    /// Edge lengths; zero when empty.
    pub fn size(&self) -> DVec2 {
        if self.is_empty() { DVec2::ZERO } else { self.max - self.min }
    }

    /// The middle; zero when empty.
    pub fn center(&self) -> DVec2 {
        if self.is_empty() { DVec2::ZERO } else { self.min * 0.5 + self.max * 0.5 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_box_is_neutral_and_sizeless() {
        let unit = Aabb::of([DVec3::ZERO, DVec3::ONE]);
        assert!(Aabb::EMPTY.is_empty() && !unit.is_empty());
        assert_eq!(Aabb::EMPTY.union(unit), unit);
        assert_eq!(unit.union(Aabb::EMPTY), unit);
        assert_eq!(Aabb::EMPTY.size(), DVec3::ZERO);
        assert_eq!(Aabb::EMPTY.center(), DVec3::ZERO);
        assert!(!Aabb::EMPTY.contains(DVec3::ZERO, 1e9));
    }

    #[test]
    fn a_box_holds_its_points_and_no_more_than_the_tolerance_beyond() {
        let aabb = Aabb::of([DVec3::new(1.0, -2.0, 3.0), DVec3::new(-1.0, 2.0, 5.0)]);
        assert_eq!(aabb.size(), DVec3::new(2.0, 4.0, 2.0));
        assert_eq!(aabb.center(), DVec3::new(0.0, 0.0, 4.0));
        assert!(aabb.contains(DVec3::new(1.0, 2.0, 5.0), 0.0));
        assert!(!aabb.contains(DVec3::new(1.1, 2.0, 5.0), 0.05));
        assert!(aabb.contains(DVec3::new(1.1, 2.0, 5.0), 0.2));
        assert_eq!(aabb.plan().size(), DVec2::new(2.0, 4.0));
    }

    #[test]
    fn a_nan_never_enters_a_box() {
        let mut aabb = Aabb::of([DVec3::NAN]);
        assert!(aabb.is_empty());
        aabb.extend(DVec3::ONE);
        aabb.extend(DVec3::new(f64::NAN, 2.0, 0.0));
        assert_eq!((aabb.min, aabb.max), (DVec3::new(1.0, 1.0, 0.0), DVec3::new(1.0, 2.0, 1.0)));
    }
}
