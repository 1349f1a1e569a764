//! Surfaces: from a statement's numbers to triangles and distant lights.

use std::f64::consts::PI;

use glam::{DVec3, Vec2};

use super::tessellate::{self, Facet};
use super::xform::Frame;
use super::{Reader, Statement, polygon};
use crate::scene::{DistantLight, SceneError, Triangle};

/// The types of surface that `add` reads.
pub(super) const TYPES: [&[u8]; 9] =
    [b"polygon", b"sphere", b"bubble", b"ring", b"cylinder", b"tube", b"cone", b"cup", b"source"];

/// Largest coordinate and length. Beyond it the area of a triangle, squared, is no longer a 32-bit number.
const FAR: f64 = 1e9;
/// Most triangles of a scene; more do not fit the memory of a usual machine, and arrays of arrays reach it soon.
const MAX_TRIANGLES: usize = 50_000_000;
/// Most points of a polygon. The time to find out that an outline crosses itself grows with the third power.
const MAX_POINTS: usize = 10_000;
/// Half angle in degrees below which a source becomes a beam, see `source`.
const BEAM: f64 = 0.15;
/// Half angle in degrees below which the rounding of its cosine to 32 bits is made good, see `source`.
const SMALL: f64 = 2.0;

/// Reads a surface of one of `TYPES` into the scene.
///
/// # Errors
/// Wrong arguments, an unknown material, and sizes that cannot be rendered.
pub(super) fn add(reader: &mut Reader, statement: &Statement, frame: &Frame) -> Result<(), SceneError> {
    let modifier = frame.modifier.as_deref().unwrap_or(statement.modifier);
    let matter = reader.library.find(modifier).map_err(|wrong| statement.error(wrong))?;
    if statement.kind == b"source" {
        return source(reader, statement, frame, matter);
    }
    let shape = Shape { statement, frame };
    let inward = matches!(statement.kind, b"bubble" | b"tube" | b"cup");
    let mut sink = Sink { reader, statement, matter, flip: inward != frame.inverted, thin: 0, added: 0 };
    match statement.kind {
        b"polygon" => shape.polygon(&mut sink)?,
        b"sphere" | b"bubble" => shape.sphere(&mut sink)?,
        b"ring" => shape.ring(&mut sink)?,
        b"cylinder" | b"tube" => shape.cylinder(&mut sink)?,
        _ => shape.cone(&mut sink)?,
    }
    sink.finish()
}

/// Takes a primitive's triangles into the scene.
struct Sink<'a, 'b> {
    reader: &'a mut Reader,
    statement: &'a Statement<'b>,
    matter: usize,
    flip: bool,
    thin: usize,
    added: usize,
}

impl Sink<'_, '_> {
    fn add(&mut self, facet: Facet) -> Result<(), SceneError> {
        let facet = if self.flip { facet.flipped() } else { facet };
        let positions = facet.corners.map(|p| p.as_vec3());
        // What has no normal in 32 bits cannot be shaded.
        let [a, b, c] = positions;
        if (b - a).cross(c - a).try_normalize().is_none() {
            self.thin += 1;
            return Ok(());
        }
        let scene = &mut self.reader.scene;
        if scene.triangles.len() >= MAX_TRIANGLES {
            return Err(self
                .statement
                .error(format_args!("makes more than {MAX_TRIANGLES} triangles; expected fewer")));
        }
        let material = self.reader.library.in_scene(self.matter, scene);
        scene.triangles.push(Triangle { positions, normals: facet.normals, uvs: [Vec2::ZERO; 3], material });
        self.added += 1;
        Ok(())
    }

    fn add_all(&mut self, facets: impl IntoIterator<Item = Facet>) -> Result<(), SceneError> {
        facets.into_iter().try_for_each(|facet| self.add(facet))
    }

    fn finish(self) -> Result<(), SceneError> {
        if self.thin > 0 {
            let message = format_args!(
                "{} of {} triangles are left out: too thin to have a normal",
                self.thin,
                self.thin + self.added
            );
            self.reader.warn(self.statement.line(message));
        }
        Ok(())
    }
}

/// The geometry of a statement, in world coordinates.
struct Shape<'a, 'b> {
    statement: &'a Statement<'b>,
    frame: &'a Frame,
}

impl Shape<'_, '_> {
    fn polygon(&self, sink: &mut Sink) -> Result<(), SceneError> {
        let reals = &self.statement.reals;
        if reals.len() < 9 || !reals.len().is_multiple_of(3) || !self.statement.strings.is_empty() {
            return Err(self.statement.error(format_args!(
                "has {} strings and {} numbers; expected none and three for each of at least three points",
                self.statement.strings.len(),
                reals.len()
            )));
        }
        if reals.len() > 3 * MAX_POINTS {
            return Err(self
                .statement
                .error(format_args!("has {} points; expected at most {MAX_POINTS}", reals.len() / 3)));
        }
        let mut points = (0..reals.len()).step_by(3).map(|i| self.point(i)).collect::<Result<Vec<_>, _>>()?;
        // The sink turns surfaces inside out; what is left is a mirror's effect on the sense of rotation.
        if self.frame.reverses() != self.frame.inverted {
            points.reverse();
        }
        let triangles = match polygon::triangulate(&points) {
            Ok(triangles) => triangles,
            Err(polygon::Flaw::Degenerate) => {
                sink.reader.warn(self.statement.line("is left out: it has no area"));
                return Ok(());
            }
            Err(polygon::Flaw::Crossed) => {
                return Err(self.statement.error("crosses itself; expected an outline with a clear inside"));
            }
        };
        if triangles.warped {
            sink.reader.warn(self.statement.line("is not flat; its triangles follow its points"));
        }
        sink.add_all(triangles.corners.iter().map(|c| Facet { corners: c.map(|i| points[i]), normals: None }))
    }

    fn sphere(&self, sink: &mut Sink) -> Result<(), SceneError> {
        self.statement.needs_reals(4, "centre radius")?;
        let (centre, radius) = (self.point(0)?, self.radius(3)?);
        if radius == 0.0 {
            return Err(self.statement.error("radius is 0; expected more"));
        }
        sink.add_all(tessellate::sphere(centre, radius))
    }

    fn ring(&self, sink: &mut Sink) -> Result<(), SceneError> {
        self.statement.needs_reals(8, "centre normal radius radius")?;
        let centre = self.point(0)?;
        let normal = self.frame.vector(self.triple(3));
        let normal =
            normal.try_normalize().ok_or_else(|| self.statement.error("normal is zero; expected a direction"))?;
        let (one, other) = (self.radius(6)?, self.radius(7)?);
        if one == other {
            return Err(self.statement.error(format_args!("both radii are {one}; expected two different ones")));
        }
        sink.add_all(tessellate::frustum(centre, normal, 0.0, one.max(other), one.min(other)))
    }

    fn cylinder(&self, sink: &mut Sink) -> Result<(), SceneError> {
        self.statement.needs_reals(7, "start end radius")?;
        let radius = self.radius(6)?;
        self.mantle(sink, radius, radius)
    }

    fn cone(&self, sink: &mut Sink) -> Result<(), SceneError> {
        self.statement.needs_reals(8, "start end radius radius")?;
        let (bottom, top) = (self.radius(6)?, self.radius(7)?);
        self.mantle(sink, bottom, top)
    }

    fn mantle(&self, sink: &mut Sink, bottom: f64, top: f64) -> Result<(), SceneError> {
        if bottom == 0.0 && top == 0.0 {
            return Err(self.statement.error("radius is 0; expected more"));
        }
        let (start, end) = (self.point(0)?, self.point(3)?);
        let axis = (end - start)
            .try_normalize()
            .ok_or_else(|| self.statement.error("starts and ends at the same point; expected two"))?;
        sink.add_all(tessellate::frustum(start, axis, (end - start).length(), bottom, top))
    }

    fn triple(&self, at: usize) -> DVec3 {
        DVec3::from_slice(&self.statement.reals[at..at + 3])
    }

    fn point(&self, at: usize) -> Result<DVec3, SceneError> {
        let p = self.frame.point(self.triple(at));
        if p.is_finite() && p.abs().max_element() <= FAR {
            return Ok(p);
        }
        let DVec3 { x, y, z } = p;
        Err(self.statement.error(format_args!("has a point at {x} {y} {z}; expected coordinates within {FAR:e}")))
    }

    fn radius(&self, at: usize) -> Result<f64, SceneError> {
        let radius = self.frame.length(self.statement.reals[at]);
        if (0.0..=FAR).contains(&radius) {
            return Ok(radius);
        }
        Err(self.statement.error(format_args!("radius is {radius}; expected 0 to {FAR:e}")))
    }
}

/// A disc of the sky: `source`, whose arguments are the direction to its middle and the full angle across, in degrees.
///
/// Two things make up for 32-bit cosines. Below `BEAM` degrees of half angle the disc becomes a beam whose irradiance is
/// radiance times the exact solid angle: 1 - cos has hardly any digits left there, and penumbras are too narrow to see.
/// From there to `SMALL` the disc stays, for its penumbra (the sun has 0.27), and its radiance is scaled by the exact
/// over the rounded solid angle, less than 1 %, so that what it lights is exact.
fn source(reader: &mut Reader, statement: &Statement, frame: &Frame, matter: usize) -> Result<(), SceneError> {
    statement.needs_reals(4, "direction angle")?;
    let to_light = frame
        .vector(DVec3::from_slice(&statement.reals[..3]))
        .try_normalize()
        .ok_or_else(|| statement.error("direction is zero; expected the way to the light"))?;
    let angle = statement.reals[3];
    if !(angle > 0.0 && angle <= 360.0) {
        return Err(statement.error(format_args!("angle is {angle} degrees; expected more than 0 and at most 360")));
    }
    let matter = reader.library.matter(matter);
    if matter.reflection.is_some() {
        return Err(statement.error("has a material that reflects; expected light or glow"));
    }
    let (half, radiance) = (angle / 2.0, matter.emission);
    // 1 - cos without cancellation.
    let exact = 2.0 * libm::sin(half.to_radians() / 2.0).powi(2);
    let cosine = (1.0 - exact) as f32;
    let (cos_half_angle, strength) = if half < BEAM {
        (1.0, radiance * (2.0 * PI * exact))
    } else if half < SMALL {
        (cosine, radiance * (exact / (1.0 - f64::from(cosine))))
    } else {
        // A right angle must be the hemisphere exactly.
        (if angle == 180.0 { 0.0 } else { cosine }, radiance)
    };
    let strength = strength.as_vec3();
    reader.scene.distant.push(DistantLight { to_light: to_light.as_vec3().normalize(), cos_half_angle, strength });
    Ok(())
}
