//! Where the picture is taken from.

use glam::Vec3;

/// A perspective or parallel view. Pictures map (x, y) in [-1, 1]² to rays; y points up.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Name in the file; empty for views.
    pub name: String,
    /// Eye, world coordinates.
    pub eye: Vec3,
    /// From the eye to the centre of the picture plane (unit length).
    pub forward: Vec3,
    /// From the centre of the picture plane to the middle of its right edge.
    pub right: Vec3,
    /// From the centre of the picture plane to the middle of its top edge.
    pub up: Vec3,
    /// When true all rays run along `forward` and the eye moves instead.
    pub parallel: bool,
}

impl Camera {
    /// Looks from `eye` along `direction`. `horizontal` and `vertical` are full angles in radians for a perspective
    /// view, full extents in world lengths for a parallel one.
    ///
    /// # Errors
    /// One line saying which argument makes no view.
    pub fn look(
        eye: Vec3,
        direction: Vec3,
        up: Vec3,
        horizontal: f32,
        vertical: f32,
        parallel: bool,
    ) -> Result<Self, String> {
        if !(eye.is_finite() && direction.is_finite() && up.is_finite()) {
            return Err("view point, direction and up must be finite numbers".into());
        }
        let forward = direction.try_normalize().ok_or("view direction must not be zero")?;
        let side = forward.cross(up).try_normalize().ok_or("view up must not be zero or parallel to the direction")?;
        let top = side.cross(forward);
        // 32 bits hold the squares, and the ratios to one another in pictures of any shape.
        let extent = |size: f32, what: &str| -> Result<f32, String> {
            let most = if parallel { 1e12 } else { std::f32::consts::PI };
            if size > 1e-12 && size < most {
                return Ok(if parallel { size / 2.0 } else { libm::tanf(size / 2.0) });
            }
            Err(match parallel {
                true => format!("{what} view size {size} is out of range; expected a length between 1e-12 and 1e12"),
                false => format!(
                    "{what} view size {} is out of range; expected degrees between 1e-10 and 180",
                    size.to_degrees()
                ),
            })
        };
        Ok(Self {
            name: String::new(),
            eye,
            forward,
            right: side * extent(horizontal, "horizontal")?,
            up: top * extent(vertical, "vertical")?,
            parallel,
        })
    }

    /// Width over height of the picture.
    pub fn aspect(&self) -> f32 {
        self.right.length() / self.up.length()
    }

    /// The same view with another width over height: the vertical size stays.
    pub fn with_aspect(mut self, aspect: f32) -> Self {
        self.right *= aspect / self.aspect();
        self
    }

    /// Origin and unit direction of the ray through picture coordinates `x`, `y` in [-1, 1], y up.
    pub fn ray(&self, x: f32, y: f32) -> (Vec3, Vec3) {
        let offset = self.right * x + self.up * y;
        if self.parallel { (self.eye + offset, self.forward) } else { (self.eye, (self.forward + offset).normalize()) }
    }
}
