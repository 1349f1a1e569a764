//! Which nodes a ray visits, and in which order: the same whoever tests the boxes.

use super::ray::Ray;
use super::{Child, Hit, NUMBERS, Node, Tree, WIDTH};

/// Tests eight at once. All implementations give the same bits. `ANY` is whether the ray asks for any hit: a function
/// for each, so that both are compiled into their loops.
pub trait Lanes: Copy {
    /// Which of a node's boxes the ray meets between 0 and `t_max`, a bit each, and how far away.
    fn boxes<const ANY: bool>(self, node: &Node, ray: &Ray, t_max: f32) -> (u32, [f32; WIDTH]);

    /// Which of `count` triangles at the beginning of `leaf` the ray meets with 0 < t <= `t_max`, a bit each, and where.
    fn triangles<const ANY: bool>(self, leaf: &[f32], count: usize, ray: &Ray, t_max: f32) -> (u32, Met);

    /// Asks for memory that is read soon, so many bytes from `from` on.
    fn prefetch<T>(self, from: &[T], bytes: usize);
}

/// Where eight triangles were met.
#[derive(Default)]
pub struct Met {
    /// Distances.
    pub t: [f32; WIDTH],
    /// Weights of the second and third corner, and of all three together.
    pub v: [f32; WIDTH],
    pub w: [f32; WIDTH],
    pub det: [f32; WIDTH],
}

/// A child still to visit: how far away its box is, as bits, and what it is. Nearer ones are less.
pub type Entry = u64;

#[inline(always)]
fn entry(near: f32, child: Child) -> Entry {
    u64::from(near.to_bits()) << 32 | u64::from(child.0)
}

/// See [`super::Bvh::closest`]. Nearer boxes first.
#[inline(always)]
pub fn closest(tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry], lanes: impl Lanes) -> Option<Hit> {
    let (nodes, leaves) = (&tree.nodes[..], &tree.leaves[..]);
    let mut best: Option<Hit> = None;
    let (mut t_max, mut triangle) = (t_max, 0);
    let mut top = 0;
    let mut child = tree.root;
    loop {
        if child.is_leaf() {
            let (leaf, count) = (&leaves[child.before() * NUMBERS..], child.count());
            let (mut mask, met) = lanes.triangles::<false>(leaf, count, ray, t_max);
            while mask != 0 {
                let lane = mask.trailing_zeros() as usize % WIDTH;
                mask &= mask - 1;
                let (t, index) = (met.t[lane], leaf[(NUMBERS - 1) * count + lane].to_bits());
                // At the very end of the ray no index is below 0.
                if t < t_max || (t == t_max && index < triangle) {
                    (t_max, triangle) = (t, index);
                    let det = met.det[lane];
                    best = Some(Hit { triangle, t, uv: [met.v[lane] / det, met.w[lane] / det] });
                }
            }
        } else {
            let node = &nodes[child.0 as usize];
            let (mut mask, near) = lanes.boxes::<false>(node, ray, t_max);
            let base = top;
            while mask != 0 {
                let slot = mask.trailing_zeros() as usize % WIDTH;
                mask &= mask - 1;
                prefetch(nodes, leaves, node.children[slot], lanes);
                let new = entry(near[slot], node.children[slot]);
                let mut at = top;
                while at > base && stack[at - 1] < new {
                    stack[at] = stack[at - 1];
                    at -= 1;
                }
                stack[at] = new;
                top += 1;
            }
        }
        loop {
            if top == 0 {
                return best;
            }
            top -= 1;
            if f32::from_bits((stack[top] >> 32) as u32) <= t_max {
                break;
            }
        }
        child = Child(stack[top] as u32);
    }
}

/// See [`super::Bvh::occluded`]. Leaves first.
#[inline(always)]
pub fn occluded(tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry], lanes: impl Lanes) -> bool {
    let (nodes, leaves) = (&tree.nodes[..], &tree.leaves[..]);
    let mut top = 0;
    let mut child = tree.root;
    loop {
        if child.is_leaf() {
            let leaf = &leaves[child.before() * NUMBERS..];
            let (mut mask, met) = lanes.triangles::<true>(leaf, child.count(), ray, t_max);
            while mask != 0 {
                let lane = mask.trailing_zeros() as usize % WIDTH;
                mask &= mask - 1;
                if met.t[lane] < t_max {
                    return true;
                }
            }
        } else {
            let node = &nodes[child.0 as usize];
            let (mut mask, _) = lanes.boxes::<true>(node, ray, t_max);
            while mask != 0 {
                let slot = mask.trailing_zeros() as usize % WIDTH;
                mask &= mask - 1;
                prefetch(nodes, leaves, node.children[slot], lanes);
                stack[top] = entry(0.0, node.children[slot]);
                top += 1;
            }
        }
        if top == 0 {
            return false;
        }
        top -= 1;
        child = Child(stack[top] as u32);
    }
}

#[inline(always)]
fn prefetch(nodes: &[Node], leaves: &[f32], child: Child, lanes: impl Lanes) {
    if child.is_leaf() {
        lanes.prefetch(&leaves[child.before() * NUMBERS..], child.count() * NUMBERS * size_of::<f32>());
    } else {
        lanes.prefetch(&nodes[child.0 as usize..], size_of::<Node>());
    }
}
