//! Eight at once by AVX2. No operation is fused, none reordered: see [`super::portable`] for what is computed.
#![allow(unsafe_code)] // Functions compiled for AVX2 are called only with the proof that the machine has it.

use std::arch::x86_64::*;

use super::portable::on_edge;
use super::ray::Ray;
use super::traverse::{self, Entry, Lanes, Met};
use super::{Hit, Node, Tree, WIDTH};

/// Proof that this machine has AVX2: nothing else makes one but [`Self::detect`].
#[derive(Clone, Copy)]
pub struct Avx2(());

impl Avx2 {
    /// Asks the machine.
    pub fn detect() -> Option<Self> {
        is_x86_feature_detected!("avx2").then_some(Self(()))
    }

    /// See [`super::Bvh::closest`].
    pub fn closest(self, tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry]) -> Option<Hit> {
        #[target_feature(enable = "avx2")]
        fn closest(lanes: Avx2, tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry]) -> Option<Hit> {
            traverse::closest(tree, ray, t_max, stack, lanes)
        }
        // SAFETY: `self` proves that there is AVX2.
        unsafe { closest(self, tree, ray, t_max, stack) }
    }

    /// See [`super::Bvh::occluded`].
    pub fn occluded(self, tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry]) -> bool {
        #[target_feature(enable = "avx2")]
        fn occluded(lanes: Avx2, tree: &Tree, ray: &Ray, t_max: f32, stack: &mut [Entry]) -> bool {
            traverse::occluded(tree, ray, t_max, stack, lanes)
        }
        // SAFETY: `self` proves that there is AVX2.
        unsafe { occluded(self, tree, ray, t_max, stack) }
    }
}

impl Lanes for Avx2 {
    #[inline(always)]
    fn boxes<const ANY: bool>(self, node: &Node, ray: &Ray, t_max: f32) -> (u32, [f32; WIDTH]) {
        // SAFETY: `self` proves that there is AVX2.
        unsafe { boxes::<ANY>(node, ray, t_max) }
    }

    #[inline(always)]
    fn triangles<const ANY: bool>(self, leaf: &[f32], count: usize, ray: &Ray, t_max: f32) -> (u32, Met) {
        // SAFETY: `self` proves that there is AVX2.
        unsafe { triangles::<ANY>(leaf, count, ray, t_max) }
    }

    #[inline(always)]
    fn prefetch<T>(self, from: &[T], bytes: usize) {
        // The last line too, wherever the first begins.
        for line in 0..(bytes + 124) / 64 {
            let at = from.as_ptr().cast::<i8>().wrapping_add(64 * line);
            // SAFETY: prefetching reads nothing and never faults.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(at) }
        }
    }
}

#[inline]
#[target_feature(enable = "avx2")]
fn load(a: &[f32; WIDTH]) -> __m256 {
    _mm256_setr_ps(a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7])
}

#[inline]
#[target_feature(enable = "avx2")]
fn store(v: __m256) -> [f32; WIDTH] {
    bytemuck::cast(v)
}

#[inline]
#[target_feature(enable = "avx2")]
fn boxes<const ANY: bool>(node: &Node, ray: &Ray, t_max: f32) -> (u32, [f32; WIDTH]) {
    let mut near = _mm256_setzero_ps();
    let mut far = _mm256_set1_ps(t_max);
    for axis in 0..3 {
        let inverse = _mm256_set1_ps(ray.inverse[axis]);
        let entry = load(&node.planes[ray.first[axis] & 1][axis]);
        let exit = load(&node.planes[1 - (ray.first[axis] & 1)][axis]);
        let entry = _mm256_mul_ps(_mm256_sub_ps(entry, _mm256_set1_ps(ray.origins[0][axis])), inverse);
        let exit = _mm256_mul_ps(_mm256_sub_ps(exit, _mm256_set1_ps(ray.origins[1][axis])), inverse);
        near = _mm256_max_ps(entry, near);
        far = _mm256_min_ps(exit, far);
    }
    let mask = _mm256_movemask_ps(_mm256_cmp_ps::<_CMP_LE_OQ>(near, far)) as u32;
    (mask, store(near))
}

#[inline]
#[target_feature(enable = "avx2")]
fn edge(p: [__m256; 3], q: [__m256; 3]) -> __m256 {
    _mm256_sub_ps(_mm256_mul_ps(p[0], q[1]), _mm256_mul_ps(p[1], q[0]))
}

/// Lanes in which any of three edges compares so with zero.
#[inline]
#[target_feature(enable = "avx2")]
fn any<const COMPARISON: i32>(edges: &[__m256; 3]) -> u32 {
    let zero = _mm256_setzero_ps();
    let [p, q, r] = [
        _mm256_cmp_ps::<COMPARISON>(edges[0], zero),
        _mm256_cmp_ps::<COMPARISON>(edges[1], zero),
        _mm256_cmp_ps::<COMPARISON>(edges[2], zero),
    ];
    _mm256_movemask_ps(_mm256_or_ps(_mm256_or_ps(p, q), r)) as u32
}

// Corners and axes are what is counted here; names for their elements would hide that.
#[allow(clippy::needless_range_loop)]
#[inline]
#[target_feature(enable = "avx2")]
fn triangles<const ANY: bool>(leaf: &[f32], count: usize, ray: &Ray, t_max: f32) -> (u32, Met) {
    let zero = _mm256_setzero_ps();
    let mut turned = [[zero; 3]; 3];
    for corner in 0..3 {
        let mut offset = [zero; 3];
        for axis in 0..3 {
            let from = (3 * corner + ray.axes[axis]) * count;
            let Some(eight) = leaf.get(from..).and_then(|rest| rest.first_chunk()) else { return (0, Met::default()) };
            offset[axis] = _mm256_sub_ps(load(eight), _mm256_set1_ps(ray.origin[axis]));
        }
        for axis in 0..2 {
            turned[corner][axis] =
                _mm256_sub_ps(offset[axis], _mm256_mul_ps(_mm256_set1_ps(ray.shear[axis]), offset[2]));
        }
        turned[corner][2] = _mm256_mul_ps(_mm256_set1_ps(ray.shear[2]), offset[2]);
    }
    let [a, b, c] = turned;
    let mut edges = [edge(c, b), edge(a, c), edge(b, a)];
    let valid = (1u32 << count) - 1;
    let mut on_edges = any::<_CMP_EQ_OQ>(&edges) & valid;
    if on_edges != 0 {
        let corners = [
            [store(a[0]), store(a[1]), store(a[2])],
            [store(b[0]), store(b[1]), store(b[2])],
            [store(c[0]), store(c[1]), store(c[2])],
        ];
        let mut stored = [store(edges[0]), store(edges[1]), store(edges[2])];
        while on_edges != 0 {
            let lane = on_edges.trailing_zeros() as usize % WIDTH;
            on_edges &= on_edges - 1;
            let [a, b, c] = corners.map(|corner| corner.map(|axis| axis[lane]));
            let [u, v, w] = on_edge(a, b, c);
            (stored[0][lane], stored[1][lane], stored[2][lane]) = (u, v, w);
        }
        edges = [load(&stored[0]), load(&stored[1]), load(&stored[2])];
    }
    let [u, v, w] = edges;
    let outside = any::<_CMP_LT_OQ>(&edges) & any::<_CMP_GT_OQ>(&edges);
    let inside = valid & !outside;
    if inside == 0 {
        return (0, Met::default());
    }
    let det = _mm256_add_ps(_mm256_add_ps(u, v), w);
    let sum = _mm256_add_ps(_mm256_mul_ps(u, a[2]), _mm256_mul_ps(v, b[2]));
    let t = _mm256_div_ps(_mm256_add_ps(sum, _mm256_mul_ps(w, c[2])), det);
    let ahead = _mm256_cmp_ps::<_CMP_GT_OQ>(t, zero);
    let near = _mm256_cmp_ps::<_CMP_LE_OQ>(t, _mm256_set1_ps(t_max));
    let solid = _mm256_cmp_ps::<_CMP_NEQ_UQ>(det, zero);
    let mask = inside & _mm256_movemask_ps(_mm256_and_ps(_mm256_and_ps(ahead, near), solid)) as u32;
    (mask, Met { t: store(t), v: store(v), w: store(w), det: store(det) })
}
