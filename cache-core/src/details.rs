//! The practical details of irradiance caching, each with the choices the literature knows; `ambience-bench details` measures
//! them against each other. Only the default metric is chosen by such a chart so far, the rest by the course notes.
//!
//! Sources: course notes of 2007, "Implementation details"; Tabellion, Lamorlette 2004; Krivanek et al. 2006; Jarosz et
//! al. 2012; Schwarzhaupt, Jensen, Jarosz 2012.

/// What says how far a record may count.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Metric {
    /// The split sphere: R alone (Ward 1988).
    SplitSphere,
    /// Second derivatives of the surroundings as the gather saw them, and never farther than R.
    Hessian,
}

/// How the lengths of a gather's rays become R.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Distance {
    /// Their harmonic mean (Ward 1988).
    Harmonic,
    /// The least of them (Tabellion, Lamorlette 2004).
    Nearest,
}

/// How translational gradients come from a gather's samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Gradients {
    /// None: records are constant where they count (Ward 1988).
    None,
    /// Borders of the cells move as fast as the nearer of both sides demands (Ward, Heckbert 1992).
    Borders,
    /// The same with each sample's own angle in its place (Krivanek et al. 2005b, "irradiance gradient").
    Samples,
    /// The samples as a mesh of triangles (Schwarzhaupt et al. 2012).
    Mesh,
}

/// How much a record counts at relative error e, where `a` is allowed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Weighting {
    /// 1 / e: jumps where a record's reach ends (Ward 1988).
    Inverse,
    /// 1 - e / a: finite everywhere (after Tabellion, Lamorlette 2004).
    Linear,
    /// 1 / e - 1 / a (course notes).
    InverseToZero,
}

/// Errors count as at least this part of the allowed one, so that a query on the site itself stays finite.
const ERROR_MIN: f32 = 1e-4;

impl Weighting {
    /// Weight at relative error `error` where `a` is allowed; more than 0 where it is less, else at most 0.
    #[inline]
    pub fn weight(self, error: f32, a: f32) -> f32 {
        if error >= a {
            return 0.0;
        }
        match self {
            Self::Inverse => 1.0 / error.max(ERROR_MIN * a),
            Self::Linear => 1.0 - error / a,
            Self::InverseToZero => 1.0 / error.max(ERROR_MIN * a) - 1.0 / a,
        }
    }
}

/// What keeps records from crowding in corners.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Spacing {
    /// A least reach in pixels, projected along the whole way of the light to the camera, mirrors included.
    Pixels,
    /// A least reach in world length, as a fraction of the scene's radius.
    World,
    /// Nothing.
    Free,
}

/// One choice for each detail.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Details {
    /// Reach of a record.
    pub metric: Metric,
    /// Distance to the surroundings.
    pub distance: Distance,
    /// Translational gradients.
    pub gradients: Gradients,
    /// Whether each colour has gradients of its own, or all share the relative one of their sum.
    pub gradients_per_channel: bool,
    /// Whether the rotational gradient is used, which also carries smooth normals (Ward, Heckbert 1992).
    pub rotation: bool,
    /// Whether R is at most |E| / |∇_t E| (Krivanek 2006 eq. 2).
    pub radius_by_gradient: bool,
    /// Whether gradients shrink by as much as the least reach stretched R (Krivanek 2006).
    pub gradient_by_radius: bool,
    /// Whether a neighbor's R plus its distance bounds R (Krivanek 2006, 5.2).
    pub neighbor_clamping: bool,
    /// Weights.
    pub weighting: Weighting,
    /// Least reach.
    pub spacing: Spacing,
    /// Whether records shrink where they make visible steps (Krivanek 2006, 4).
    pub adaptive: bool,
    /// Order of all records of radiance; `None`: what each material's lobes need (Krivanek 2005, 4.1).
    pub order: Option<usize>,
}

impl Default for Details {
    fn default() -> Self {
        Self {
            metric: Metric::Hessian,
            distance: Distance::Harmonic,
            gradients: Gradients::Borders,
            gradients_per_channel: true,
            rotation: true,
            radius_by_gradient: true,
            gradient_by_radius: true,
            neighbor_clamping: true,
            weighting: Weighting::InverseToZero,
            spacing: Spacing::Pixels,
            adaptive: false,
            order: None,
        }
    }
}
