//! The wide tree: a binary tree by obvhs, its nodes merged so that a ray is expected to do the least work.

use glam::{Vec3, Vec3A};
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;

use super::huge::Huge;
use super::{Child, NUMBERS, Node, Tree, WIDTH};
use crate::scene::Triangle;

/// Cost of testing one leaf in node tests.
const LEAF_COST: f32 = 0.8;

/// More reinsertion than obvhs' medium: built once, traced through for the whole picture.
const PARAMS: BvhBuildParams =
    BvhBuildParams { max_prims_per_leaf: 1, reinsertion_batch_ratio: 0.1, ..BvhBuildParams::medium_build() };

impl Tree {
    /// Builds the tree.
    pub fn new(triangles: &[Triangle]) -> Self {
        let corner = |t: &Triangle, pick: fn(Vec3A, Vec3A) -> Vec3A| {
            let [a, b, c] = t.positions.map(Vec3A::from);
            pick(pick(a, b), c)
        };
        let boxes: Vec<_> = triangles.iter().map(|t| Aabb::new(corner(t, Vec3A::min), corner(t, Vec3A::max))).collect();
        let binary = build_bvh2(&boxes, PARAMS, &mut std::time::Duration::default());
        let plan = Plan::new(&binary);
        let bounds = binary.nodes.first().map_or([Vec3::ZERO; 2], |root| [root.aabb.min.into(), root.aabb.max.into()]);
        let mut nodes = Vec::new();
        let mut leaves = Vec::with_capacity(triangles.len() * NUMBERS + WIDTH);
        let mut depth = 1;
        let root = match plan.leaf.first() {
            None => {
                // A triangle no ray meets.
                leaves.resize(NUMBERS, f32::NAN);
                Child::leaf(0, 1)
            }
            Some(true) => add_leaf(&binary, 0, triangles, &mut leaves),
            Some(false) => {
                nodes.push(Node::EMPTY);
                let mut open = vec![(0, 0, 1)];
                let mut children = Vec::with_capacity(WIDTH);
                while let Some((at, from, level)) = open.pop() {
                    depth = depth.max(level);
                    plan.children(&binary, from, &mut children);
                    children.sort_by_key(|&child| plan.leaf[child as usize]);
                    for (slot, &child) in children.iter().enumerate() {
                        let reference = if plan.leaf[child as usize] {
                            add_leaf(&binary, child, triangles, &mut leaves)
                        } else {
                            // Siblings lie side by side.
                            open.push((nodes.len(), child, level + 1));
                            nodes.push(Node::EMPTY);
                            Child::node(nodes.len() - 1)
                        };
                        let bounds = &binary.nodes[child as usize].aabb;
                        nodes[at].set(slot, bounds.min.into(), bounds.max.into(), reference);
                    }
                }
                Child::node(0)
            }
        };
        // A leaf is read eight triangles wide, however few it has.
        leaves.resize(leaves.len() + WIDTH, 0.0);
        Self { bounds, nodes: Huge::new(&nodes), leaves: Huge::new(&leaves), root, depth }
    }
}

/// Files the triangles under a node of the binary tree.
fn add_leaf(binary: &Bvh2, node: u32, triangles: &[Triangle], leaves: &mut Vec<f32>) -> Child {
    let mut found = Vec::with_capacity(WIDTH);
    let mut open = vec![node];
    while let Some(node) = open.pop() {
        let node = &binary.nodes[node as usize];
        if node.is_leaf() {
            found.push(binary.primitive_indices[node.first_index as usize]);
        } else {
            open.extend([node.first_index, node.first_index + 1]);
        }
    }
    let leaf = Child::leaf(leaves.len() / NUMBERS, found.len());
    for corner in 0..3 {
        for axis in 0..3 {
            leaves.extend(found.iter().map(|&i| triangles[i as usize].positions[corner][axis]));
        }
    }
    leaves.extend(found.iter().map(|&i| f32::from_bits(i)));
    leaf
}

/// Which nodes of the binary tree remain, by dynamic programming over the surface area heuristic: for every node the least
/// cost of representing it by up to i subtrees (Ylitie, Karras and Laine 2017, section 3.1).
struct Plan {
    /// Whether a node is a leaf, should it remain.
    leaf: Vec<bool>,
    /// How many of i subtrees the left child gets; 0 if one subtree fewer is no worse. Index i - 1.
    left: Vec<[u8; WIDTH]>,
}

impl Plan {
    fn new(binary: &Bvh2) -> Self {
        let nodes = &binary.nodes;
        let mut order: Vec<u32> = Vec::with_capacity(nodes.len());
        let mut open = if nodes.is_empty() { Vec::new() } else { vec![0] };
        while let Some(at) = open.pop() {
            order.push(at);
            let node = &nodes[at as usize];
            if !node.is_leaf() {
                open.extend([node.first_index, node.first_index + 1]);
            }
        }
        let mut plan = Self { leaf: vec![true; nodes.len()], left: vec![[0; WIDTH]; nodes.len()] };
        let mut count = vec![1u32; nodes.len()];
        let mut cost = vec![[0f32; WIDTH - 1]; nodes.len()];
        for &at in order.iter().rev() {
            let at = at as usize;
            let node = &nodes[at];
            let area = node.aabb.half_area();
            if node.is_leaf() {
                cost[at] = [area * LEAF_COST; WIDTH - 1];
                continue;
            }
            let [l, r] = [node.first_index as usize, node.first_index as usize + 1];
            count[at] = count[l].saturating_add(count[r]);
            let mut shared = [0.0; WIDTH + 1];
            for roots in 2..=WIDTH {
                let (k, best) = (1..roots)
                    .map(|k| (k, cost[l][(k - 1).min(WIDTH - 2)] + cost[r][(roots - k - 1).min(WIDTH - 2)]))
                    .reduce(|a, b| if b.1 < a.1 { b } else { a })
                    .unwrap_or((1, 0.0));
                shared[roots] = best;
                plan.left[at][roots - 1] = k as u8;
            }
            let whole = area * LEAF_COST;
            let split = area + shared[WIDTH];
            plan.leaf[at] = count[at] as usize <= WIDTH && whole <= split;
            cost[at][0] = if plan.leaf[at] { whole } else { split };
            for roots in 2..WIDTH {
                let fewer = cost[at][roots - 2];
                if fewer <= shared[roots] {
                    plan.left[at][roots - 1] = 0;
                }
                cost[at][roots - 1] = fewer.min(shared[roots]);
            }
        }
        plan
    }

    /// The nodes of the binary tree that become the children of `node`.
    fn children(&self, binary: &Bvh2, node: u32, children: &mut Vec<u32>) {
        children.clear();
        let mut open = vec![(node, WIDTH)];
        while let Some((at, mut roots)) = open.pop() {
            let left = &self.left[at as usize];
            while roots > 1 && left[roots - 1] == 0 {
                roots -= 1;
            }
            if roots == 1 {
                children.push(at);
            } else {
                let (first, k) = (binary.nodes[at as usize].first_index, usize::from(left[roots - 1]));
                open.extend([(first + 1, roots - k), (first, k)]);
            }
        }
    }
}
