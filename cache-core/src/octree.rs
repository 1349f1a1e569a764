//! Files balls in the order of an octree's cells; says which may hold a point.
//!
//! Balls stand in Morton order of their centres, the order in which an octree without end is walked, eight to a block; eight
//! blocks make a cell, eight cells a larger one. What belongs together follows from the place in the row, so that no pointers
//! are kept, and each cell knows the boxes of what its eight parts reach: a question tests eight at once.

use std::cmp::Ordering;

use glam::{Vec3, Vec4};

/// Parts of a cell, balls of a block: two vectors of four lanes.
const WIDTH: usize = 8;

/// Levels of cells over `u32::MAX` balls.
const LEVELS_MAX: usize = 10;

/// A ball is filed so much wider that no rounding of a distance loses it.
const SLACK: f32 = 1.0 + 1e-5;

/// Eight numbers, one for each part.
type Eight = [Vec4; 2];

/// Balls, each known by its place in Morton order.
#[derive(Clone, Debug, Default)]
pub struct Octree {
    blocks: Vec<Block>,
    /// Cells over blocks, cells over those, and so on up to one root.
    levels: Vec<Vec<Cell>>,
}

/// Eight balls: centres and squared reaches.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Block {
    center: [Eight; 3],
    square: Eight,
}

/// The boxes of eight parts.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
struct Cell {
    low: [Eight; 3],
    high: [Eight; 3],
}

impl Octree {
    /// Files balls (center, reach; world lengths, both at most 1e19) that stand in [`order`].
    pub fn new(balls: impl ExactSizeIterator<Item = (Vec3, f32)>) -> Self {
        let count = balls.len().div_ceil(WIDTH);
        let mut blocks = vec![Block::EMPTY; count];
        let mut boxes = vec![Aabb::EMPTY; count];
        for (i, (center, reach)) in balls.enumerate() {
            let reach = reach * SLACK;
            blocks[i / WIDTH].set(i % WIDTH, center, reach);
            // A border that is rounded has no point on its other side.
            boxes[i / WIDTH].unite(Aabb { low: center - reach, high: center + reach });
        }
        let mut levels = Vec::new();
        while boxes.len() > 1 {
            let mut cells = vec![Cell::EMPTY; boxes.len().div_ceil(WIDTH)];
            let mut outer = vec![Aabb::EMPTY; cells.len()];
            for (i, inner) in boxes.iter().enumerate() {
                cells[i / WIDTH].set(i % WIDTH, *inner);
                outer[i / WIDTH].unite(*inner);
            }
            levels.push(cells);
            boxes = outer;
        }
        Self { blocks, levels }
    }

    /// Calls `visit` with the place of every ball that may hold `point`, in order; stops when it returns false.
    #[inline]
    pub fn visit(&self, point: Vec3, mut visit: impl FnMut(usize) -> bool) {
        let point = [Vec4::splat(point.x), Vec4::splat(point.y), Vec4::splat(point.z)];
        let mut in_block = |at: usize| {
            let mut hit = self.blocks[at].holding(point);
            while hit != 0 {
                if !visit(at * WIDTH + hit.trailing_zeros() as usize) {
                    return false;
                }
                hit &= hit - 1;
            }
            true
        };
        // Of each level, the cell at work and its parts still to be seen.
        let mut open = [(0, 0); LEVELS_MAX];
        let Some(top) = self.levels.len().checked_sub(1) else {
            if !self.blocks.is_empty() {
                in_block(0);
            }
            return;
        };
        open[top] = (0, self.levels[top][0].holding(point));
        let mut level = top;
        loop {
            let (cell, parts) = open[level];
            if parts == 0 {
                if level == top {
                    return;
                }
                level += 1;
                continue;
            }
            open[level].1 = parts & (parts - 1);
            let part = cell * WIDTH + parts.trailing_zeros() as usize;
            if level > 0 {
                level -= 1;
                open[level] = (part, self.levels[level][part].holding(point));
            } else if !in_block(part) {
                return;
            }
        }
    }

    /// Bytes it takes.
    pub fn bytes(&self) -> usize {
        let cells: usize = self.levels.iter().map(Vec::len).sum();
        self.blocks.len() * size_of::<Block>() + cells * size_of::<Cell>()
    }
}

impl Block {
    /// Holds nothing: no square is below 0.
    const EMPTY: Self = Self { center: [[Vec4::ZERO; 2]; 3], square: [Vec4::NEG_ONE; 2] };

    fn set(&mut self, lane: usize, center: Vec3, reach: f32) {
        for axis in 0..3 {
            self.center[axis][lane / 4][lane % 4] = center[axis];
        }
        self.square[lane / 4][lane % 4] = reach * reach;
    }

    /// Which balls hold the point, a bit each.
    #[inline]
    fn holding(&self, [x, y, z]: [Vec4; 3]) -> u32 {
        let half = |i: usize| {
            let (x, y, z) = (x - self.center[0][i], y - self.center[1][i], z - self.center[2][i]);
            (x * x + y * y + z * z).cmple(self.square[i]).bitmask()
        };
        half(0) | half(1) << 4
    }
}

impl Cell {
    /// Holds nothing.
    const EMPTY: Self = Self { low: [[Vec4::INFINITY; 2]; 3], high: [[Vec4::NEG_INFINITY; 2]; 3] };

    fn set(&mut self, lane: usize, part: Aabb) {
        for axis in 0..3 {
            self.low[axis][lane / 4][lane % 4] = part.low[axis];
            self.high[axis][lane / 4][lane % 4] = part.high[axis];
        }
    }

    /// Which parts' boxes hold the point, a bit each.
    #[inline]
    fn holding(&self, [x, y, z]: [Vec4; 3]) -> u32 {
        let half = |i: usize| {
            let within = |p: Vec4, axis: usize| p.cmpge(self.low[axis][i]) & p.cmple(self.high[axis][i]);
            (within(x, 0) & within(y, 1) & within(z, 2)).bitmask()
        };
        half(0) | half(1) << 4
    }
}

#[derive(Clone, Copy)]
struct Aabb {
    low: Vec3,
    high: Vec3,
}

impl Aabb {
    const EMPTY: Self = Self { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY };

    fn unite(&mut self, other: Self) {
        (self.low, self.high) = (self.low.min(other.low), self.high.max(other.high));
    }
}

/// Morton order of finite points: that of the bits of their coordinates taken in turn, however many there are (after Connor and
/// Kumar 2010). A total order of places; `Equal` only for the same place.
pub fn order(a: Vec3, b: Vec3) -> Ordering {
    // Of two zeros neither is the lesser.
    let (a, b) = (a + Vec3::ZERO, b + Vec3::ZERO);
    let (mut axis, mut highest) = (2, highest_difference(a.z, b.z));
    for i in [1, 0] {
        let here = highest_difference(a[i], b[i]);
        if here > highest {
            (axis, highest) = (i, here);
        }
    }
    a[axis].total_cmp(&b[axis])
}

/// Place of the highest bit in which two numbers differ.
fn highest_difference(a: f32, b: f32) -> i32 {
    const MANTISSA: u32 = (1 << 23) - 1;
    let parts = |v: f32| {
        let (exponent, mantissa) = (v.to_bits() >> 23 & 0xff, v.to_bits() & MANTISSA);
        // Below the least exponent there is no leading 1.
        if exponent == 0 { (1, mantissa) } else { (exponent as i32, mantissa | 1 << 23) }
    };
    if a.is_sign_negative() != b.is_sign_negative() {
        return i32::MAX;
    }
    let ((e, m), (f, n)) = (parts(a), parts(b));
    match m ^ n {
        _ if e != f => e.max(f),
        0 => i32::MIN,
        differ => e - differ.leading_zeros() as i32 + 8,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::id::Random;

    fn tree(balls: &mut [(Vec3, f32)]) -> Octree {
        balls.sort_by(|a, b| order(a.0, b.0));
        Octree::new(balls.iter().copied())
    }

    proptest! {
        #[test]
        fn finds_every_ball_that_holds_the_point_once_and_in_order(
            balls in prop::collection::vec((prop::array::uniform3(-9f32..9.0), 1e-4f32..5.0), 0..700),
            points in prop::collection::vec(prop::array::uniform3(-12f32..12.0), 1..20),
        ) {
            let mut balls: Vec<_> = balls.into_iter().map(|(c, r)| (Vec3::from(c), r)).collect();
            let tree = tree(&mut balls);
            for point in points.into_iter().map(Vec3::from) {
                let mut seen = vec![];
                tree.visit(point, |i| { seen.push(i); true });
                prop_assert!(seen.is_sorted_by(|a, b| a < b));
                for (i, (c, r)) in balls.iter().enumerate() {
                    let distance = c.distance(point);
                    let found = seen.binary_search(&i).is_ok();
                    prop_assert!(found || distance >= *r);
                    prop_assert!(!found || distance <= *r * 1.001 + 1e-5, "a ball that is far away");
                }
            }
        }

        /// The order is that of integers' bits taken in turn where coordinates are integers.
        #[test]
        fn order_is_that_of_interleaved_bits(a in prop::array::uniform3(0u32..1 << 20), b in prop::array::uniform3(0u32..1 << 20)) {
            let key = |p: [u32; 3]| {
                (0..60).fold(0u64, |key, bit| key | u64::from(p[bit % 3] >> (bit / 3) & 1) << bit)
            };
            let point = |p: [u32; 3]| Vec3::from(p.map(|v| v as f32));
            prop_assert_eq!(order(point(a), point(b)), key(a).cmp(&key(b)));
        }

        #[test]
        fn order_is_total(bits in prop::array::uniform9(any::<u32>())) {
            let v = bits.map(|b| Some(f32::from_bits(b)).filter(|v| v.is_finite()).unwrap_or(0.0));
            let [a, b, c] = [0, 3, 6].map(|i| Vec3::from_slice(&v[i..]));
            prop_assert_eq!(order(a, b), order(b, a).reverse());
            prop_assert!(order(a, b).is_gt() || order(b, c).is_gt() || order(a, c).is_le());
            prop_assert_eq!(order(a, a), Ordering::Equal);
        }
    }

    #[test]
    fn zeros_and_the_least_numbers_have_their_places() {
        let x = |x: f32| Vec3::new(x, 0.0, 0.0);
        let row = [-1.0, -1e-40, 0.0, 1e-45, 1e-40, 2e-38, 1.0];
        assert!(row.is_sorted_by(|a, b| order(x(*a), x(*b)).is_lt()));
        assert_eq!(order(x(0.0), x(-0.0)), Ordering::Equal);
    }

    /// Balls far smaller than what lies between them, and others that span all.
    #[test]
    fn extreme_balls_hide_no_other() {
        let near = (0..50).map(|i| (Vec3::new(0.37, 0.11, 0.73) * (1.0 + i as f32 * 0.01), 1e-5f32));
        let far = [(-3e6, 30.0), (1e18, 1e-38), (-1e18, 1.0), (1e18, 1e18), (0.5, 1e18), (0.0, 1e-38)];
        let mut balls: Vec<_> = near.chain(far.map(|(c, r)| (Vec3::splat(c), r))).collect();
        let tree = tree(&mut balls);
        for (i, (center, reach)) in balls.iter().enumerate() {
            for at in [*center, *center + Vec3::X * *reach * 0.9, *center - Vec3::splat(*reach * 0.5)] {
                let mut seen = false;
                tree.visit(at, |ball| {
                    seen |= ball == i;
                    true
                });
                assert!(seen, "ball {i} of {reach} round {center} at {at}");
            }
        }
        tree.visit(Vec3::splat(f32::NAN), |_| panic!("nowhere"));
    }

    /// Where squares lose digits, far from the origin where places do, and anywhere a rounding inside the border.
    #[test]
    fn no_rounding_loses_a_ball() {
        let mut random = Random::named("borders", &[]);
        let mut direction = || Vec3::from([(); 3].map(|()| random.uniform() - 0.5)).normalize();
        for k in 0..40_000 {
            let reach = [1e-23 * 1.1f32.powi(k % 80), 1e-3, 2.0, 1e9][k as usize % 4];
            for center in [Vec3::ZERO, Vec3::new(0.3, 0.7, -0.2), Vec3::new(1e3, -7e5, 3e6)] {
                let at = center + direction() * reach;
                let tree = Octree::new([(center, reach), (center + 1.0, reach)].into_iter());
                let mut seen = false;
                tree.visit(at, |ball| {
                    seen |= ball == 0;
                    true
                });
                assert!(seen || center.distance(at) >= reach * (1.0 - 1e-7), "{reach} round {center}: {at}");
            }
        }
    }
}
