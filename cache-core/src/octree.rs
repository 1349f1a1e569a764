//! Files balls by size and place; says which may hold a point.
//!
//! A ball is filed at the level whose cells are 2 to 4 times its reach, in each of the at most 8 cells it touches, so
//! that a question walks one path from the root and sees every ball once (after Ward 1988, 3.3, with the search moved
//! to insertion).

use glam::Vec3;

/// Deepest level below the root; smaller balls are filed there too.
const DEPTH_MAX: u32 = 40;

/// No cell.
const NONE: u32 = 0;

/// Indices of balls, in cells.
#[derive(Clone, Debug, Default)]
pub struct Octree {
    low: Vec3,
    size: f32,
    cells: Vec<Cell>,
}

#[derive(Clone, Debug, Default)]
struct Cell {
    children: [u32; 8],
    balls: Vec<u32>,
}

impl Octree {
    /// Files ball `index` with `center` and `reach` (world lengths, both at most 1e18).
    pub fn insert(&mut self, index: u32, center: Vec3, reach: f32) {
        // A reach below the spacing of floats round the centre could not tell one cell from the next.
        let reach = reach.max(center.abs().max_element() * 1e-6).max(1e-30);
        self.grow_to_hold(center, reach);
        self.file(0, self.low, self.size, 0, index, center, reach);
    }

    fn grow_to_hold(&mut self, center: Vec3, reach: f32) {
        let (low, high) = (center - reach, center + reach);
        if self.cells.is_empty() {
            self.cells.push(Cell::default());
            self.low = low;
            self.size = 2.0 * reach;
        }
        while !(low.cmpge(self.low).all() && high.cmple(self.low + self.size).all()) {
            // Double towards the side that is short; the old root becomes one child of the new.
            let mut octant = 0;
            for axis in 0..3 {
                if low[axis] < self.low[axis] {
                    self.low[axis] -= self.size;
                    octant |= 1 << axis;
                }
            }
            self.size *= 2.0;
            let mut root = Cell::default();
            root.children[octant] = self.cells.len() as u32;
            let old = std::mem::replace(&mut self.cells[0], root);
            self.cells.push(old);
        }
    }

    #[allow(clippy::too_many_arguments)]
    fn file(&mut self, cell: usize, low: Vec3, size: f32, depth: u32, index: u32, center: Vec3, reach: f32) {
        if size < 4.0 * reach || depth == DEPTH_MAX {
            self.cells[cell].balls.push(index);
            return;
        }
        let half = size * 0.5;
        for octant in 0..8 {
            let corner = low + half * offset(octant);
            let gap = (corner - center).max(center - (corner + half)).max_element();
            if gap > reach {
                continue;
            }
            let mut child = self.cells[cell].children[octant];
            if child == NONE {
                child = self.cells.len() as u32;
                self.cells.push(Cell::default());
                self.cells[cell].children[octant] = child;
            }
            self.file(child as usize, corner, half, depth + 1, index, center, reach);
        }
    }

    /// Calls `visit` with every ball whose reach may hold `point`; stops when it returns false.
    #[inline]
    pub fn visit(&self, point: Vec3, mut visit: impl FnMut(u32) -> bool) {
        let inside = point.cmpge(self.low).all() && point.cmple(self.low + self.size).all();
        if self.cells.is_empty() || !inside {
            return;
        }
        let (mut cell, mut low, mut size) = (0, self.low, self.size);
        loop {
            let here = &self.cells[cell];
            for &ball in &here.balls {
                if !visit(ball) {
                    return;
                }
            }
            size *= 0.5;
            let upper = point.cmpge(low + size);
            let octant = upper.bitmask() as usize;
            low += size * offset(octant);
            match here.children[octant] {
                NONE => return,
                child => cell = child as usize,
            }
        }
    }
}

fn offset(octant: usize) -> Vec3 {
    Vec3::new((octant & 1) as f32, (octant >> 1 & 1) as f32, (octant >> 2) as f32)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn finds_every_ball_that_holds_the_point_and_each_once(
            balls in prop::collection::vec((prop::array::uniform3(-9f32..9.0), 1e-4f32..5.0), 1..120),
            points in prop::collection::vec(prop::array::uniform3(-12f32..12.0), 1..60),
        ) {
            let mut tree = Octree::default();
            for (i, (c, r)) in balls.iter().enumerate() {
                tree.insert(i as u32, Vec3::from(*c), *r);
            }
            for point in points.into_iter().map(Vec3::from) {
                let mut seen = vec![0; balls.len()];
                tree.visit(point, |i| { seen[i as usize] += 1; true });
                for (i, (c, r)) in balls.iter().enumerate() {
                    prop_assert!(seen[i] <= 1);
                    if Vec3::from(*c).distance(point) < *r {
                        prop_assert_eq!(seen[i], 1);
                    }
                }
            }
        }
    }

    #[test]
    fn extreme_balls_are_filed_without_end_or_panic() {
        let mut tree = Octree::default();
        for (i, (c, r)) in [(0.0, 1e-38), (1e18, 1e-38), (-1e18, 1.0), (1e18, 1e18), (0.5, 1e18)].iter().enumerate() {
            tree.insert(i as u32, Vec3::splat(*c), *r);
        }
        tree.visit(Vec3::splat(0.5), |_| true);
        tree.visit(Vec3::splat(f32::NAN), |_| true);
    }
}
