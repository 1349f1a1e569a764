//! The passes of a device, put together from `wgsl/`.

use cache_core::hsh::rotation::{STEPS, Table, table};
use cache_core::of_order;

use crate::device::Gpu;
use crate::layout::IRRADIANCE;

/// What sums are blended in. Half floats would lose half a percent.
pub const SUMS_FORMAT: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;

const TYPES: &str = include_str!("../wgsl/types.wgsl");
const REACH: &str = include_str!("../wgsl/reach.wgsl");
const WEIGH: &str = include_str!("../wgsl/weigh.wgsl");
const ESTIMATE_IRRADIANCE: &str = include_str!("../wgsl/estimate_irradiance.wgsl");
const ESTIMATE_RADIANCE: &str = include_str!("../wgsl/estimate_radiance.wgsl");
const SPLAT: &str = include_str!("../wgsl/splat.wgsl");
const SUM: &str = include_str!("../wgsl/sum.wgsl");
const NORMALISE: &str = include_str!("../wgsl/normalise.wgsl");
const SUMMED_BLENDED: &str = include_str!("../wgsl/summed_blended.wgsl");
const SUMMED_STORED: &str = include_str!("../wgsl/summed_stored.wgsl");

/// How records of one kind are drawn.
pub enum Draw {
    /// As quads, blended.
    Blend(wgpu::RenderPipeline),
    /// Tile by tile.
    Sum(wgpu::ComputePipeline),
}

impl Draw {
    /// For records of a kind.
    pub fn new(gpu: &Gpu, kind: u32) -> Self {
        let estimate = match kind {
            IRRADIANCE => ESTIMATE_IRRADIANCE.to_string(),
            order => format!("const ORDER: u32 = {order}u;\nconst STEPS: u32 = {STEPS}u;\n{ESTIMATE_RADIANCE}"),
        };
        let last = if gpu.blends { SPLAT } else { SUM };
        let module = module(gpu, &[TYPES, REACH, WEIGH, &estimate, last]);
        if !gpu.blends {
            return Self::Sum(compute(gpu, &module, "sum"));
        }
        let add = wgpu::BlendComponent {
            src_factor: wgpu::BlendFactor::One,
            dst_factor: wgpu::BlendFactor::One,
            operation: wgpu::BlendOperation::Add,
        };
        let target = |write_mask| {
            Some(wgpu::ColorTargetState {
                format: SUMS_FORMAT,
                blend: Some(wgpu::BlendState { color: add, alpha: add }),
                write_mask,
            })
        };
        let radiance = if kind == IRRADIANCE { wgpu::ColorWrites::empty() } else { wgpu::ColorWrites::ALL };
        let targets = [target(wgpu::ColorWrites::ALL), target(wgpu::ColorWrites::ALL), target(radiance)];
        Self::Blend(gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: None,
            layout: None,
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("quad"),
                compilation_options: Default::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState { topology: wgpu::PrimitiveTopology::TriangleStrip, ..Default::default() },
            depth_stencil: None,
            multisample: Default::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("splat"),
                compilation_options: Default::default(),
                targets: &targets,
            }),
            multiview_mask: None,
            cache: None,
        }))
    }

    /// The layout of a group of bindings.
    pub fn layout(&self, group: u32) -> wgpu::BindGroupLayout {
        match self {
            Self::Blend(pipeline) => pipeline.get_bind_group_layout(group),
            Self::Sum(pipeline) => pipeline.get_bind_group_layout(group),
        }
    }
}

/// Divides sums by weights.
pub fn normalise(gpu: &Gpu) -> wgpu::ComputePipeline {
    let summed = if gpu.blends { SUMMED_BLENDED } else { SUMMED_STORED };
    compute(gpu, &module(gpu, &[TYPES, summed, NORMALISE]), "normalise")
}

/// The tables by which records of an order rotate: matrices, and which coefficient each of their rows is.
pub fn tilts(gpu: &Gpu, order: u32) -> Option<[wgpu::Buffer; 2]> {
    let Table { index, matrices } = of_order!(order as usize, N => table::<N>())?;
    let index: Vec<u32> = index.concat().into_iter().map(|i| i as u32).collect();
    let storage = wgpu::BufferUsages::STORAGE;
    let matrices = matrices.concat();
    Some([gpu.buffer(bytemuck::cast_slice(&matrices), storage), gpu.buffer(bytemuck::cast_slice(&index), storage)])
}

fn module(gpu: &Gpu, parts: &[&str]) -> wgpu::ShaderModule {
    let source = wgpu::ShaderSource::Wgsl(parts.concat().into());
    gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source })
}

fn compute(gpu: &Gpu, module: &wgpu::ShaderModule, entry: &str) -> wgpu::ComputePipeline {
    gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module,
        entry_point: Some(entry),
        compilation_options: Default::default(),
        cache: None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// On machines without a graphics adapter too.
    #[test]
    fn shaders_are_sound() {
        let radiance =
            |order| format!("const ORDER: u32 = {order}u;\nconst STEPS: u32 = {STEPS}u;\n{ESTIMATE_RADIANCE}");
        let mut sources = vec![[TYPES, SUMMED_BLENDED, NORMALISE].concat(), [TYPES, SUMMED_STORED, NORMALISE].concat()];
        for estimate in [ESTIMATE_IRRADIANCE.to_string(), radiance(2), radiance(10)] {
            for last in [SPLAT, SUM] {
                sources.push([TYPES, REACH, WEIGH, &estimate, last].concat());
            }
        }
        for source in sources {
            let module =
                wgpu::naga::front::wgsl::parse_str(&source).unwrap_or_else(|e| panic!("{}", e.emit_to_string(&source)));
            let flags = wgpu::naga::valid::ValidationFlags::all();
            let mut validator = wgpu::naga::valid::Validator::new(flags, wgpu::naga::valid::Capabilities::empty());
            validator.validate(&module).expect("it is sound");
        }
    }
}
