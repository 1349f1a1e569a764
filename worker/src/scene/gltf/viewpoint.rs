//! Cameras of nodes.

use ::gltf::json::camera::{Camera as Lens, Type};
use ::gltf::json::scene::Node;
use ::gltf::json::validation::Checked;
use ::gltf::json::{Index, Root};
use glam::DVec3;

use super::container::beyond;
use super::placement::Placement;
use super::{Fault, name};
use crate::scene::Camera;

/// The camera `index` at `place`: it looks along -Z of the node, its up is +Y. A perspective camera without aspectRatio
/// is square. The near and far planes cut nothing off.
pub(super) fn camera(root: &Root, index: Index<Lens>, node: &Node, place: &Placement) -> Result<Camera, Fault> {
    let lens = root.get(index).ok_or_else(|| format!("camera {index} {}", beyond(root.cameras.len())))?;
    let named = |fault: String| format!("{}: {fault}", name("camera", lens.name.as_deref(), index.value()));
    let sizes = picture_size(lens).map_err(named)?;
    let axis = |axis: DVec3| place.direction(axis).ok_or_else(|| named("its node has no orientation".into()));
    let (forward, up) = (axis(DVec3::NEG_Z)?, axis(DVec3::Y)?);
    let mut camera =
        Camera::look(place.origin(), forward, up, sizes.horizontal, sizes.vertical, sizes.parallel).map_err(named)?;
    camera.name = node.name.as_ref().or(lens.name.as_ref()).cloned().unwrap_or_default();
    Ok(camera)
}

/// Full angles in radians; full lengths where `parallel`.
struct PictureSize {
    horizontal: f32,
    vertical: f32,
    parallel: bool,
}

fn picture_size(lens: &Lens) -> Result<PictureSize, Fault> {
    match (lens.type_, &lens.perspective, &lens.orthographic) {
        (Checked::Valid(Type::Perspective), Some(p), _) => {
            let aspect = p.aspect_ratio.unwrap_or(1.0);
            if !(aspect > 0.0 && aspect.is_finite()) {
                return Err(format!("aspectRatio is {aspect}; expected more than 0"));
            }
            if !(p.yfov > 0.0 && p.yfov < std::f32::consts::PI) {
                return Err(format!("yfov is {}; expected between 0 and pi", p.yfov));
            }
            let horizontal = 2.0 * libm::atan(f64::from(aspect) * libm::tan(f64::from(p.yfov) / 2.0));
            Ok(PictureSize { horizontal: horizontal as f32, vertical: p.yfov, parallel: false })
        }
        (Checked::Valid(Type::Orthographic), _, Some(o)) => {
            for (field, size) in [("xmag", o.xmag), ("ymag", o.ymag)] {
                if !(size > 0.0 && size.is_finite()) {
                    return Err(format!("{field} is {size}; expected more than 0"));
                }
            }
            Ok(PictureSize { horizontal: 2.0 * o.xmag, vertical: 2.0 * o.ymag, parallel: true })
        }
        (Checked::Valid(kind), _, _) => Err(format!("type is {kind:?}, but the values of that type are missing")),
        (Checked::Invalid, _, _) => Err("unknown type; expected perspective or orthographic".into()),
    }
}
