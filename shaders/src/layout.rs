//! What passes read and write, laid out as `wgsl/types.wgsl` has it.

use bytemuck::{Pod, Zeroable};
use cache_core::Query;
use worker::levels::{CountingRecord, IRRADIANCE_VALUES, Level};
use worker::settings::Settings;

/// Camera and region of the picture.
#[derive(Clone, Copy, PartialEq, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct View {
    /// Eye, world.
    pub eye: [f32; 3],
    /// 1 for parallel rays, else 0.
    pub parallel: u32,
    /// Unit vector the camera looks along.
    pub forward: [f32; 3],
    /// Columns of the region.
    pub width: u32,
    /// Unit vector to the right of the picture.
    pub right: [f32; 3],
    /// Rows of the region.
    pub height: u32,
    /// Unit vector to the bottom of the picture.
    pub down: [f32; 3],
    #[doc(hidden)]
    pub pad: u32,
    /// Pixels per unit of slope, or of length where rays are parallel.
    pub scale: [f32; 2],
    /// Pixel coordinates, from the region's corner, of what the eye looks straight at.
    pub centre: [f32; 2],
}

impl View {
    /// The region of a picture from column and row `x0`, `y0` to `x1`, `y1` (exclusive).
    pub fn new(settings: &Settings, [x0, x1, y0, y1]: [u32; 4]) -> Self {
        let camera = &settings.camera;
        let (across, up) = (camera.right.length(), camera.up.length());
        let half = [settings.width as f32 * 0.5, settings.height as f32 * 0.5];
        Self {
            eye: camera.eye.to_array(),
            parallel: camera.parallel.into(),
            forward: camera.forward.to_array(),
            width: x1 - x0,
            right: (camera.right / across).to_array(),
            height: y1 - y0,
            down: (-camera.up / up).to_array(),
            pad: 0,
            scale: [half[0] / across, half[1] / up],
            centre: [half[0] - x0 as f32, half[1] - y0 as f32],
        }
    }
}

/// Where a record lies and how far it counts.
#[derive(Clone, Copy, PartialEq, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Site {
    /// p_i, world.
    pub position: [f32; 3],
    /// R it counts with, world length.
    pub radius: f32,
    /// Unit normal.
    pub normal: [f32; 3],
    /// a_i.
    pub a: f32,
    /// (xx, xy, yy) of M, 1/m².
    pub ellipse: [f32; 3],
    /// How much of its gradients holds.
    pub limit: f32,
    /// Standard error of its value.
    pub noise: f32,
    #[doc(hidden)]
    pub pad: [u32; 3],
}

impl Site {
    fn new(r: &CountingRecord) -> Self {
        Self {
            position: r.position.to_array(),
            radius: r.counting.radius,
            normal: r.normal.to_array(),
            a: r.counting.a,
            ellipse: r.ellipse,
            limit: r.counting.limit,
            noise: r.noise,
            pad: [0; 3],
        }
    }
}

/// [`Point::kind`] of points that records of irradiance serve; those of radiance have their order, others 0.
pub const IRRADIANCE: u32 = 1;

/// Where a pixel asks.
#[derive(Clone, Copy, PartialEq, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Point {
    /// World position.
    pub position: [f32; 3],
    /// Which records serve it.
    pub kind: u32,
    /// Unit normal by which records count.
    pub normal: [f32; 3],
    /// Number of its lobe among those of its order.
    pub lobe: u32,
    /// Unit normal the answer is for.
    pub shading: [f32; 3],
    #[doc(hidden)]
    pub pad: u32,
}

impl Point {
    /// Where a query asks records of a kind.
    pub fn new(query: &Query, kind: u32, lobe: u32) -> Self {
        let (position, normal) = (query.position.to_array(), query.normal.to_array());
        Self { position, kind, normal, lobe, shading: query.shading.to_array(), pad: 0 }
    }
}

/// What a pixel is told.
#[derive(Clone, Copy, PartialEq, Default, Debug, Pod, Zeroable)]
#[repr(C)]
pub struct Answer {
    /// Irradiance, W/m².
    pub irradiance: [f32; 3],
    /// Standard error of irradiance, or of coefficients of radiance.
    pub noise: f32,
    /// What the lobe reflects of records of radiance, W/(sr m²).
    pub radiance: [f32; 3],
    /// How many records; 0 where none covers the point.
    pub records: f32,
}

/// All records of one kind, in the order of their ids: that in which they are drawn.
pub struct Splats {
    /// As [`Point::kind`].
    pub kind: u32,
    /// Where they lie.
    pub sites: Vec<Site>,
    /// What they say: as many floats for each as [`Self::stride`] tells.
    pub values: Vec<f32>,
}

impl Splats {
    /// Those of a level, kind by kind.
    pub fn of(level: &Level) -> Vec<Self> {
        std::iter::once(None).chain(level.orders().map(Some)).map(|order| Self::of_kind(level, order)).collect()
    }

    fn of_kind(level: &Level, order: Option<usize>) -> Self {
        let (mut ids, mut sites, mut values) = (Vec::new(), Vec::new(), Vec::new());
        level.counting(order, &mut |record| {
            ids.push(record.id);
            sites.push(Site::new(&record));
            values.extend_from_slice(record.values);
        });
        let kind = order.map_or(IRRADIANCE, |order| order as u32);
        let stride = stride(kind);
        let mut order: Vec<usize> = (0..ids.len()).collect();
        order.sort_unstable_by_key(|i| ids[*i]);
        Self {
            kind,
            sites: order.iter().map(|i| sites[*i]).collect(),
            values: order.iter().flat_map(|i| &values[i * stride..(i + 1) * stride]).copied().collect(),
        }
    }

    /// Floats of each record in [`Self::values`].
    pub fn stride(&self) -> usize {
        stride(self.kind)
    }
}

fn stride(kind: u32) -> usize {
    if kind == IRRADIANCE { IRRADIANCE_VALUES } else { 9 * (kind * kind) as usize }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use wgpu::naga::{TypeInner, front::wgsl};

    use super::*;

    /// Offset and name of each member of a struct of types.wgsl, and its size.
    fn members(name: &str) -> (Vec<(u32, String)>, u32) {
        let module = wgsl::parse_str(include_str!("../wgsl/types.wgsl")).expect("it parses");
        let named = module.types.iter().find(|(_, t)| t.name.as_deref() == Some(name)).expect("it is there");
        let TypeInner::Struct { members, span } = &named.1.inner else { panic!("{name} is no struct") };
        (members.iter().map(|m| (m.offset, m.name.clone().expect("a name"))).collect(), *span)
    }

    macro_rules! same {
        ($struct:ident: $($field:ident),*) => {{
            let (members, span) = members(stringify!($struct));
            let own = [$((offset_of!($struct, $field) as u32, stringify!($field).to_string())),*];
            let padding = |name: &str| name.starts_with("pad");
            assert_eq!(span as usize, size_of::<$struct>());
            assert_eq!(members.into_iter().filter(|(_, name)| !padding(name)).collect::<Vec<_>>(), own);
        }};
    }

    #[test]
    fn structs_are_those_of_the_shaders() {
        same!(View: eye, parallel, forward, width, right, height, down, scale, centre);
        same!(Site: position, radius, normal, a, ellipse, limit, noise);
        same!(Point: position, kind, normal, lobe, shading);
        same!(Answer: irradiance, noise, radiance, records);
    }
}
