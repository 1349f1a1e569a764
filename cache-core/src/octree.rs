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
    /// Half the size of the root, whose middle is the origin.
    half: f32,
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
        self.file(0, Vec3::splat(-self.half), 2.0 * self.half, 0, index, center, reach);
    }

    /// The root reaches as far on one side of the origin as on the other, a power of two: the borders of all cells are then
    /// multiples of their sizes, which no sum rounds, and where a ball is found does not depend on the order of filing.
    fn grow_to_hold(&mut self, center: Vec3, reach: f32) {
        let farthest = center.abs().max_element() + reach;
        if self.cells.is_empty() {
            self.cells.push(Cell::default());
            self.half = power_of_two(farthest);
        }
        while self.half < farthest {
            self.half *= 2.0;
            // What was an eighth of the root is now an eighth of an eighth, its corner still at the origin.
            let eighths = self.cells[0].children;
            for (octant, inner) in eighths.into_iter().enumerate().filter(|(_, inner)| *inner != NONE) {
                let mut outer = Cell::default();
                outer.children[7 ^ octant] = inner;
                self.cells[0].children[octant] = self.cells.len() as u32;
                self.cells.push(outer);
            }
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
        if self.cells.is_empty() || !point.abs().cmple(Vec3::splat(self.half)).all() {
            return;
        }
        let (mut cell, mut low, mut size) = (0, Vec3::splat(-self.half), 2.0 * self.half);
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

/// The least power of two that is at least `size`.
fn power_of_two(size: f32) -> f32 {
    const MANTISSA: u32 = (1 << 23) - 1;
    f32::from_bits((size.to_bits() + MANTISSA) & !MANTISSA)
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

    /// Balls far smaller than what lies between them: found in any order of filing.
    #[test]
    fn one_ball_far_away_hides_no_other() {
        let near = |i: u32| (Vec3::new(0.37, 0.11, 0.73) * (1.0 + i as f32 * 0.01), 1e-5f32);
        let far = (Vec3::new(-3e6, 2.1e6, 7.7e6), 30.0);
        for first in [true, false] {
            let mut tree = Octree::default();
            if first {
                tree.insert(99, far.0, far.1);
            }
            (0..50).for_each(|i| tree.insert(i, near(i).0, near(i).1));
            if !first {
                tree.insert(99, far.0, far.1);
            }
            for i in 0..50 {
                let (center, reach) = near(i);
                for at in [center, center + Vec3::X * reach * 0.9, center - Vec3::splat(reach * 0.5)] {
                    let mut seen = false;
                    tree.visit(at, |ball| {
                        seen |= ball == i;
                        true
                    });
                    assert!(seen, "ball {i}, the far one first: {first}");
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
