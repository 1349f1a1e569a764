//! Neighbor clamping (Krivanek et al. 2006, 5.2) in its order-free form.
//!
//! R*_i = min over all records k of (R_k + |p_i - p_k|), with R_k the raw value at birth. The paper clamps record by
//! record as they arrive; by the triangle inequality one hop over raw values gives the closure of that rule, so every
//! replica derives the same bits whatever the order.

use glam::Vec3;

/// Points in a leaf.
const LEAF: usize = 8;

/// Answers min over k of (R_k + |p - p_k|): a k-d tree over sites whose boxes know their least R.
#[derive(Clone, Debug, Default)]
pub struct Clamp {
    sites: Vec<(Vec3, f32)>,
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    low: Vec3,
    high: Vec3,
    radius_min: f32,
    start: u32,
    end: u32,
    /// Index of the second child; the first follows its parent. 0 in a leaf.
    second: u32,
}

impl Clamp {
    /// Files sites (position, raw R).
    pub fn new(sites: Vec<(Vec3, f32)>) -> Self {
        let mut clamp = Self { nodes: Vec::with_capacity(sites.len() / LEAF * 4 + 1), sites };
        if !clamp.sites.is_empty() {
            clamp.build(0, clamp.sites.len());
        }
        clamp
    }

    fn build(&mut self, start: usize, end: usize) {
        let sites = &mut self.sites[start..end];
        let (mut low, mut high, mut radius_min) = (sites[0].0, sites[0].0, f32::INFINITY);
        for (p, r) in sites.iter() {
            (low, high, radius_min) = (low.min(*p), high.max(*p), radius_min.min(*r));
        }
        let node = self.nodes.len();
        self.nodes.push(Node { low, high, radius_min, start: start as u32, end: end as u32, second: 0 });
        if end - start > LEAF {
            let axis = (high - low).max_position();
            let half = (end - start) / 2;
            sites.select_nth_unstable_by(half, |a, b| a.0[axis].total_cmp(&b.0[axis]));
            self.build(start, start + half);
            self.nodes[node].second = self.nodes.len() as u32;
            self.build(start + half, end);
        }
    }

    /// The least of `radius` and R_k + |position - p_k| over all sites k.
    pub fn clamp(&self, position: Vec3, radius: f32) -> f32 {
        // Rounding may make a box look a little farther than a site inside it.
        const SLACK: f32 = 1.0 - 1e-5;
        let mut least = radius;
        let mut stack = [0u32; 64];
        let mut depth = usize::from(!self.nodes.is_empty());
        while depth > 0 {
            depth -= 1;
            let at = stack[depth];
            let node = &self.nodes[at as usize];
            let gap = (node.low - position).max(position - node.high).max(Vec3::ZERO).length();
            if (node.radius_min + gap) * SLACK >= least {
                continue;
            }
            if node.second == 0 {
                for (p, r) in &self.sites[node.start as usize..node.end as usize] {
                    least = least.min(r + p.distance(position));
                }
            } else {
                stack[depth] = node.second;
                stack[depth + 1] = at + 1;
                depth += 2;
            }
        }
        least
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn sites() -> impl Strategy<Value = Vec<(Vec3, f32)>> {
        let one = (prop::array::uniform3(-4f32..4.0), 0.01f32..3.0).prop_map(|(p, r)| (Vec3::from(p), r));
        prop::collection::vec(one, 1..200)
    }

    fn brute_force(sites: &[(Vec3, f32)], position: Vec3) -> f32 {
        sites.iter().map(|(p, r)| r + p.distance(position)).fold(f32::INFINITY, f32::min)
    }

    proptest! {
        #[test]
        fn clamping_equals_brute_force_in_any_order(mut sites in sites(), turn in 0usize..200) {
            let expected: Vec<_> = sites.iter().map(|s| brute_force(&sites, s.0)).collect();
            let asked: Vec<_> = sites.clone();
            let middle = turn % sites.len();
            sites.rotate_left(middle);
            let clamp = Clamp::new(sites);
            for ((p, r), expected) in asked.into_iter().zip(expected) {
                prop_assert_eq!(clamp.clamp(p, r).to_bits(), expected.to_bits());
            }
        }

        /// The sequential rule of the paper, repeated until nothing changes, never goes below one hop over raw values.
        #[test]
        fn one_hop_over_raw_values_is_the_closure(sites in sites()) {
            let mut r: Vec<f32> = sites.iter().map(|s| s.1).collect();
            for _ in 0..3 {
                for i in 0..r.len() {
                    for k in 0..r.len() {
                        r[i] = r[i].min(r[k] + sites[i].0.distance(sites[k].0));
                    }
                }
            }
            for (s, r) in sites.iter().zip(r) {
                let one_hop = brute_force(&sites, s.0);
                prop_assert!((r - one_hop).abs() <= 1e-5 * one_hop, "{} {}", r, one_hop);
            }
        }
    }
}
