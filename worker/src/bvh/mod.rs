//! Rays against triangles: a tree eight wide, and a watertight triangle test (Woop, Benthin and Wald 2013).
//!
//! - `build`: the tree, from a binary one by obvhs.
//! - `ray`: a ray made ready.
//! - `traverse`: which nodes a ray visits, and in which order.
//! - `portable`, `avx2`: eight boxes or triangles at once, in plain Rust and by AVX2: the same operations in the same
//!   order, so the same bits.
//! - `huge`: memory in huge pages.
//!
//! Every worker builds the same tree from the same scene, and a ray asks nothing but the tree and the scene, so a hit has
//! the same bits everywhere.

#[cfg(target_arch = "x86_64")]
mod avx2;
mod build;
mod huge;
mod portable;
mod ray;
#[cfg(test)]
mod tests;
mod traverse;

use std::cell::RefCell;

use bytemuck::{Pod, Zeroable};
use glam::Vec3;

use crate::scene::Triangle;
use huge::Huge;
use portable::Portable;
use ray::Ray;
use traverse::Entry;

/// Children of a node and triangles of a leaf, at most.
const WIDTH: usize = 8;

/// Numbers a triangle takes in a leaf: nine coordinates and its index.
const NUMBERS: usize = 10;

/// Where a ray met a triangle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index into the scene's triangles; of several at the same distance the lowest.
    pub triangle: u32,
    /// Distance in lengths of the ray's direction.
    pub t: f32,
    /// Barycentric weights of the triangle's second and third corner.
    pub uv: [f32; 2],
}

/// The triangles of a scene, ready to trace.
pub struct Bvh {
    tree: Tree,
    kernel: Kernel,
}

/// How eight are tested at once.
#[derive(Clone, Copy)]
enum Kernel {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2(avx2::Avx2),
}

impl Bvh {
    /// Builds the tree.
    ///
    /// # Panics
    /// With more than 2^28 triangles.
    pub fn new(triangles: &[Triangle]) -> Self {
        #[cfg(target_arch = "x86_64")]
        let kernel = avx2::Avx2::detect().map_or(Kernel::Portable, Kernel::Avx2);
        #[cfg(not(target_arch = "x86_64"))]
        let kernel = Kernel::Portable;
        Self { tree: Tree::new(triangles), kernel }
    }

    /// The same tree, traced as on a machine without AVX2.
    pub fn portable(self) -> Self {
        Self { kernel: Kernel::Portable, ..self }
    }

    /// The nearest hit with 0 < t < `t_max`; rays meet both faces. The direction is finite and not zero.
    pub fn closest(&self, origin: Vec3, direction: Vec3, t_max: f32) -> Option<Hit> {
        let ray = Ray::new(origin, direction, &self.tree.bounds);
        self.tree.with_stack(|stack| match self.kernel {
            Kernel::Portable => traverse::closest(&self.tree, &ray, t_max, stack, Portable),
            #[cfg(target_arch = "x86_64")]
            Kernel::Avx2(avx2) => avx2.closest(&self.tree, &ray, t_max, stack),
        })
    }

    /// Whether anything lies between 0 and `t_max`, in lengths of `direction`.
    pub fn occluded(&self, origin: Vec3, direction: Vec3, t_max: f32) -> bool {
        let ray = Ray::new(origin, direction, &self.tree.bounds);
        self.tree.with_stack(|stack| match self.kernel {
            Kernel::Portable => traverse::occluded(&self.tree, &ray, t_max, stack, Portable),
            #[cfg(target_arch = "x86_64")]
            Kernel::Avx2(avx2) => avx2.occluded(&self.tree, &ray, t_max, stack),
        })
    }

    /// Memory of the tree and its copy of the triangles, bytes.
    pub fn bytes(&self) -> usize {
        size_of_val(&self.tree.nodes[..]) + size_of_val(&self.tree.leaves[..])
    }
}

struct Tree {
    /// Corners of the box round all triangles.
    bounds: [Vec3; 2],
    nodes: Huge<Node>,
    /// Leaf after leaf; within a leaf of n triangles n x-coordinates of first corners, then n y-coordinates, and so on,
    /// then n indices, as bits.
    leaves: Huge<f32>,
    root: Child,
    /// Nodes on the longest way down.
    depth: usize,
}

impl Tree {
    /// Lends room for all that a ray may still have to visit: this thread's, used again and again.
    #[inline]
    fn with_stack<R>(&self, visit: impl FnOnce(&mut [Entry]) -> R) -> R {
        thread_local!(static STACK: RefCell<Vec<Entry>> = const { RefCell::new(Vec::new()) });
        STACK.with_borrow_mut(|stack| {
            let room = self.depth * (WIDTH - 1) + 1;
            if stack.len() < room {
                stack.resize(room, 0);
            }
            visit(stack)
        })
    }
}

/// A node or a leaf: the highest bit tells which; of a leaf three bits hold the number of its triangles less one, the
/// others how many triangles lie before it.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Pod, Zeroable)]
#[repr(transparent)]
struct Child(u32);

impl Child {
    const LEAF: u32 = 1 << 31;
    const COUNT: u32 = 28;

    fn node(index: usize) -> Self {
        Self(index as u32)
    }

    fn leaf(before: usize, count: usize) -> Self {
        assert!(before < 1 << Self::COUNT, "at most 2^28 triangles");
        Self(Self::LEAF | (count as u32 - 1) << Self::COUNT | before as u32)
    }

    #[inline(always)]
    fn is_leaf(self) -> bool {
        self.0 & Self::LEAF != 0
    }

    /// Triangles of a leaf.
    #[inline(always)]
    fn count(self) -> usize {
        (self.0 >> Self::COUNT) as usize % WIDTH + 1
    }

    /// Triangles before a leaf.
    #[inline(always)]
    fn before(self) -> usize {
        self.0 as usize % (1 << Self::COUNT)
    }
}

/// Up to eight boxes and what is in them; inner nodes come before leaves.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C, align(64))]
struct Node {
    /// Low and high planes along x, y and z.
    planes: [[[f32; WIDTH]; 3]; 2],
    children: [Child; WIDTH],
    /// To four cache lines.
    unused: [u32; 8],
}

impl Node {
    /// No ray meets a box whose low planes lie above its high ones.
    const EMPTY: Self = Self {
        planes: [[[f32::INFINITY; WIDTH]; 3], [[f32::NEG_INFINITY; WIDTH]; 3]],
        children: [Child(Child::LEAF); WIDTH],
        unused: [0; 8],
    };

    fn set(&mut self, slot: usize, low: Vec3, high: Vec3, child: Child) {
        for axis in 0..3 {
            self.planes[0][axis][slot] = low[axis];
            self.planes[1][axis][slot] = high[axis];
        }
        self.children[slot] = child;
    }
}
