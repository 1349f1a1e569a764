//! Where a node lies in the world. Transforms are composed in f64 and rounded to f32 once, at the end.

use ::gltf::json::scene::Node;
use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3, Vec3};

use super::Fault;

/// A node's transform to world coordinates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placement {
    to_world: DAffine3,
    /// The inverse transpose of the linear part, but for a positive factor; exists for flattening transforms too.
    normals: DMat3,
}

impl Placement {
    /// The world's own coordinates.
    pub(super) const WORLD: Self = Self { to_world: DAffine3::IDENTITY, normals: DMat3::IDENTITY };

    /// The placement of `node`, whose parent lies at `self`.
    pub(super) fn child(&self, node: &Node) -> Result<Self, Fault> {
        let to_world = self.to_world * local(node)?;
        if !to_world.is_finite() {
            return Err("its transform is not finite".into());
        }
        let m = to_world.matrix3;
        let sign = if m.determinant() < 0.0 { -1.0 } else { 1.0 };
        let (x, y, z) = (m.x_axis, m.y_axis, m.z_axis);
        Ok(Self { to_world, normals: DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y)) * sign })
    }

    /// Whether the transform mirrors, so that corners must be reversed for the front to stay in front.
    pub(super) fn mirrors(&self) -> bool {
        self.to_world.matrix3.determinant() < 0.0
    }

    /// World coordinates of the point `local`, bit for bit the same when nothing is transformed.
    pub(super) fn point(&self, local: Vec3) -> Vec3 {
        // Even a product with ones would turn -0 into 0.
        if self.to_world == DAffine3::IDENTITY {
            return local;
        }
        self.to_world.transform_point3(local.as_dvec3()).as_vec3()
    }

    /// World coordinates of the unit surface normal along `local`; `None` if that has no direction.
    pub(super) fn normal(&self, local: Vec3) -> Option<Vec3> {
        unit(self.normals * local.as_dvec3())
    }

    /// The node's origin in world coordinates.
    pub(super) fn origin(&self) -> Vec3 {
        self.to_world.translation.as_vec3()
    }

    /// World coordinates of the unit direction `local` of the node; `None` if the transform leaves it no length.
    pub(super) fn direction(&self, local: DVec3) -> Option<Vec3> {
        unit(self.to_world.matrix3 * local)
    }
}

/// Unit vector along `v`. Scaled first, for squares of very small or large lengths leave even the range of f64.
fn unit(v: DVec3) -> Option<Vec3> {
    let largest = v.abs().max_element();
    (largest.is_finite() && largest > 0.0).then_some(())?;
    Some((v / largest).try_normalize()?.as_vec3())
}

fn local(node: &Node) -> Result<DAffine3, Fault> {
    if let Some(matrix) = node.matrix {
        let matrix = DMat4::from_cols_array(&matrix.map(f64::from));
        return match matrix.row(3).to_array() {
            [0.0, 0.0, 0.0, 1.0] => Ok(DAffine3::from_mat4(matrix)),
            row => Err(format!("matrix: its last row is {row:?}; expected [0, 0, 0, 1]")),
        };
    }
    let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    let rotation = match node.rotation {
        None => DQuat::IDENTITY,
        Some(quaternion) => {
            let q = DQuat::from_array(quaternion.0.map(f64::from));
            // Writers round; a length far from one is a mistake and not a rounding.
            if !(0.99..1.01).contains(&q.length()) {
                return Err(format!("rotation: {:?} is not a unit quaternion", quaternion.0));
            }
            q.normalize()
        }
    };
    let scale = node.scale.map_or(DVec3::ONE, vector);
    let translation = node.translation.map_or(DVec3::ZERO, vector);
    Ok(DAffine3::from_scale_rotation_translation(scale, rotation, translation))
}
