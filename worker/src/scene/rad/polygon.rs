//! Triangles of a flat outline: concave, touching itself, and with holes.
//!
//! Radiance has no holes. Its scenes draw one by going along a seam from the outline to the hole, round the hole, and
//! back along the seam; so wherever an outline comes back to a point it has visited, what lies between is a ring of
//! its own, and the seam is what remains.

use std::collections::HashMap;

use glam::{DVec2, DVec3};

/// Area over squared extent below which an outline counts as a line or a point.
const FLAT: f64 = 1e-14;
/// Height over extent above which an outline is reported as not flat.
const WARPED: f64 = 1e-3;
/// Disagreement of areas, over the squared extent, above which the triangles cannot be those of the outline.
const MISFIT: f64 = 1e-7;

/// Why an outline has no triangles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Flaw {
    /// No area.
    Degenerate,
    /// It crosses itself, so that its inside is not defined.
    Crossed,
}

/// The triangles of an outline.
#[derive(Debug)]
pub(super) struct Triangles {
    /// Corners as indices into the outline, in its sense of rotation.
    pub(super) corners: Vec<[usize; 3]>,
    /// Whether the points are noticeably off a common plane.
    pub(super) warped: bool,
}

/// Triangulates an outline of finite points.
///
/// # Errors
/// When it encloses no area or crosses itself.
pub(super) fn triangulate(points: &[DVec3]) -> Result<Triangles, Flaw> {
    let extent = extent(points);
    // Twice the area, as a vector along the normal (Newell).
    let normal: DVec3 =
        points.iter().zip(points.iter().cycle().skip(1)).map(|(&a, &b)| (a - points[0]).cross(b - points[0])).sum();
    if points.len() < 3 || normal.length() <= 2.0 * FLAT * extent * extent {
        return Err(Flaw::Degenerate);
    }
    if points.len() == 3 {
        return Ok(Triangles { corners: vec![[0, 1, 2]], warped: false });
    }
    let unit = normal.normalize();
    let warped = points.iter().any(|&p| (p - points[0]).dot(unit).abs() > WARPED * extent);
    let flat = project(points, unit, extent);
    let corners = if is_convex_quad(&flat) { vec![[0, 1, 2], [0, 2, 3]] } else { cut(points, &flat)? };
    Ok(Triangles { corners, warped })
}

/// Longest side of the bounding box.
fn extent(points: &[DVec3]) -> f64 {
    let (low, high) =
        points.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
    (high - low).max_element()
}

/// Drops the coordinate along which the normal is longest; the outline comes out counter-clockwise and of size 1.
fn project(points: &[DVec3], normal: DVec3, extent: f64) -> Vec<DVec2> {
    let axis = normal.abs().max_position();
    let (mut u, mut v) = ((axis + 1) % 3, (axis + 2) % 3);
    if normal[axis] < 0.0 {
        std::mem::swap(&mut u, &mut v);
    }
    points.iter().map(|&p| (p - points[0]) / extent).map(|p| DVec2::new(p[u], p[v])).collect()
}

fn is_convex_quad(flat: &[DVec2]) -> bool {
    flat.len() == 4 && (0..4).all(|i| turn(flat[i], flat[(i + 1) % 4], flat[(i + 2) % 4]) > FLAT)
}

/// Twice the signed area of a triangle.
fn turn(a: DVec2, b: DVec2, c: DVec2) -> f64 {
    (b - a).perp_dot(c - a)
}

/// Twice the signed area within a ring.
fn ring_area(flat: &[DVec2], ring: &[usize]) -> f64 {
    let next = ring.iter().cycle().skip(1);
    ring.iter().zip(next).map(|(&i, &j)| (flat[i] - flat[ring[0]]).perp_dot(flat[j] - flat[ring[0]])).sum()
}

fn cut(points: &[DVec3], flat: &[DVec2]) -> Result<Vec<[usize; 3]>, Flaw> {
    let (mut outer, mut holes) = (Vec::new(), Vec::new());
    let mut wanted = 0.0;
    for ring in rings(points) {
        let area = ring_area(flat, &ring);
        wanted += area;
        if area > FLAT {
            outer.push((area, ring, Vec::new()));
        } else if area < -FLAT {
            holes.push(ring);
        }
    }
    outer.sort_by(|a, b| a.0.total_cmp(&b.0));
    for hole in holes {
        // The smallest ring around it is the one it is cut out of.
        let around = outer.iter_mut().find(|(_, ring, _)| surrounds(flat, ring, &hole)).ok_or(Flaw::Crossed)?;
        around.2.push(hole);
    }
    let mut corners = Vec::new();
    for (_, ring, holes) in &outer {
        clip_ears(flat, ring, holes, &mut corners)?;
    }
    let found: f64 = corners.iter().map(|&[a, b, c]| turn(flat[a], flat[b], flat[c])).sum();
    if (found - wanted).abs() > MISFIT { Err(Flaw::Crossed) } else { Ok(corners) }
}

/// Parts the outline where it comes back to a point; what is left of seams has fewer than three points and is dropped.
fn rings(points: &[DVec3]) -> Vec<Vec<usize>> {
    // Adding zero makes -0 and 0 the same point.
    let key = |i: usize| points[i].to_array().map(|v| (v + 0.0).to_bits());
    let mut rings = Vec::new();
    let mut path: Vec<usize> = Vec::new();
    let mut places: HashMap<[u64; 3], usize> = HashMap::new();
    for i in 0..points.len() {
        match places.get(&key(i)) {
            Some(&place) => {
                let ring = path[place..].to_vec();
                for left in path.drain(place + 1..) {
                    places.remove(&key(left));
                }
                rings.push(ring);
            }
            None => {
                places.insert(key(i), path.len());
                path.push(i);
            }
        }
    }
    rings.push(path);
    rings.retain(|ring| ring.len() >= 3);
    rings
}

/// Whether `hole` lies within `ring`, which it may touch in points but not cross.
fn surrounds(flat: &[DVec2], ring: &[usize], hole: &[usize]) -> bool {
    let free = hole.iter().map(|&i| flat[i]).find(|p| ring.iter().all(|&j| flat[j] != *p));
    let probe = free.unwrap_or_else(|| (flat[hole[0]] + flat[hole[1]]) / 2.0);
    let mut inside = false;
    for (&i, &j) in ring.iter().zip(ring.iter().cycle().skip(1)) {
        let (a, b) = (flat[i], flat[j]);
        if (a.y > probe.y) != (b.y > probe.y) && probe.x < a.x + (b.x - a.x) * (probe.y - a.y) / (b.y - a.y) {
            inside = !inside;
        }
    }
    inside
}

fn clip_ears(flat: &[DVec2], ring: &[usize], holes: &[Vec<usize>], corners: &mut Vec<[usize; 3]>) -> Result<(), Flaw> {
    let mut order = ring.to_vec();
    let mut starts = Vec::with_capacity(holes.len());
    for hole in holes {
        starts.push(order.len());
        order.extend(hole);
    }
    let coordinates: Vec<f64> = order.iter().flat_map(|&i| flat[i].to_array()).collect();
    let ears = earcutr::earcut(&coordinates, &starts, 2).map_err(|_| Flaw::Crossed)?;
    for ear in ears.chunks_exact(3) {
        let [a, b, c] = [order[ear[0]], order[ear[1]], order[ear[2]]];
        match turn(flat[a], flat[b], flat[c]) {
            t if t > 0.0 => corners.push([a, b, c]),
            t if t < 0.0 => corners.push([a, c, b]),
            _ => {}
        }
    }
    Ok(())
}
