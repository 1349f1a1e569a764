//! Irradiance of records by a device: the passes of `wgsl/`, for many records at a time. Each has a plane of its own in one picture.

use std::sync::Arc;

use bytemuck::pod_collect_to_vec;
use shaders::device::Gpu;
use worker::scene::{Rgb, Triangle};
use worker::splat::Lost;

use crate::glow::Glow;
use crate::plane::{Eye, HALF};

/// Pixels of the picture's edge at most.
const EDGE_MAX: u32 = 2048;

/// Planes side by side at most.
const COLUMNS_MAX: u32 = 16;

const PLANE: &str = include_str!("../wgsl/plane.wgsl");
const RASTERISE: &str = include_str!("../wgsl/rasterise.wgsl");
const INTEGRATE: &str = include_str!("../wgsl/integrate.wgsl");

const SEEN: wgpu::TextureFormat = wgpu::TextureFormat::R32Uint;
const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

/// A scene on a device, and planes of one size.
pub struct Rasteriser {
    gpu: Arc<Gpu>,
    size: u32,
    columns: u32,
    corners: u32,
    draw: wgpu::RenderPipeline,
    sum: wgpu::ComputePipeline,
    bound: [wgpu::BindGroup; 2],
    eyes: wgpu::Buffer,
    seen: wgpu::Texture,
    depth: wgpu::TextureView,
    irradiance: wgpu::Buffer,
    read: wgpu::Buffer,
}

impl Rasteriser {
    /// One that weighs the pixels of each plane by `weights`, as [`crate::plane::weights`] gives them.
    pub fn new(gpu: Arc<Gpu>, triangles: &[Triangle], glow: &Glow, weights: &[f32]) -> Self {
        let size = weights.len().isqrt() as u32;
        let columns = (EDGE_MAX / size).clamp(1, COLUMNS_MAX);
        let module = |pass| {
            let source = wgpu::ShaderSource::Wgsl(source(size, columns, glow.cells, pass).into());
            gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source })
        };
        let draw = draw(&gpu, &module(RASTERISE));
        let sum = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: None,
            layout: None,
            module: &module(INTEGRATE),
            entry_point: Some("integrate"),
            compilation_options: Default::default(),
            cache: None,
        });
        let storage = wgpu::BufferUsages::STORAGE;
        let corners: Vec<[f32; 4]> =
            triangles.iter().flat_map(|t| t.positions.map(|p| p.extend(1.0).to_array())).collect();
        let room = u64::from(columns * columns);
        let eyes = gpu.room(room * size_of::<Eye>() as u64, storage | wgpu::BufferUsages::COPY_DST);
        let irradiance = gpu.room(room * 16, storage | wgpu::BufferUsages::COPY_SRC);
        let read = gpu.room(room * 16, wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST);
        let picture = |format, usage| {
            let edge = size * columns;
            gpu.device.create_texture(&wgpu::TextureDescriptor {
                label: None,
                size: wgpu::Extent3d { width: edge, height: edge, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            })
        };
        let seen = picture(SEEN, wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_SRC);
        let depth = picture(DEPTH, wgpu::TextureUsages::empty()).create_view(&Default::default());
        let view = seen.create_view(&Default::default());
        let count = corners.len() as u32;
        let [corners, glow, weights] =
            [bytemuck::cast_slice(&corners), bytemuck::cast_slice(&glow.radiance), bytemuck::cast_slice(weights)]
                .map(|bytes| gpu.buffer(bytes, storage));
        let both = [eyes.as_entire_binding(), corners.as_entire_binding()];
        let rest = [
            glow.as_entire_binding(),
            weights.as_entire_binding(),
            wgpu::BindingResource::TextureView(&view),
            irradiance.as_entire_binding(),
        ];
        let bound = [
            bind(&gpu, &draw.get_bind_group_layout(0), both.to_vec()),
            bind(&gpu, &sum.get_bind_group_layout(0), [&both[..], &rest].concat()),
        ];
        Self { gpu, size, columns, corners: count, draw, sum, bound, eyes, seen, depth, irradiance, read }
    }

    /// Irradiance at each of these eyes, W/m².
    ///
    /// # Errors
    /// [`Lost`]: the device has gone.
    pub fn gather(&self, eyes: &[Eye]) -> Result<Vec<Rgb>, Lost> {
        let mut all = Vec::with_capacity(eyes.len());
        for eyes in eyes.chunks((self.columns * self.columns) as usize) {
            let mut encoder = self.rasterise(eyes);
            {
                let mut pass = encoder.begin_compute_pass(&Default::default());
                pass.set_pipeline(&self.sum);
                pass.set_bind_group(0, &self.bound[1], &[]);
                pass.dispatch_workgroups(eyes.len() as u32, 1, 1);
            }
            encoder.copy_buffer_to_buffer(&self.irradiance, 0, &self.read, 0, self.read.size());
            let told: Vec<[f32; 4]> = self.told(encoder, &self.read)?;
            all.extend(told[..eyes.len()].iter().map(|&[r, g, b, _]| Rgb::new(r, g, b)));
        }
        Ok(all)
    }

    /// What the pixels of each eye's plane see, as [`crate::plane::rasterise`] has it.
    ///
    /// # Errors
    /// As [`Self::gather`].
    pub fn seen(&self, eyes: &[Eye]) -> Result<Vec<Vec<u32>>, Lost> {
        let (size, edge) = (self.size as usize, self.size * self.columns);
        // Rows of a copy are multiples of 256 bytes.
        let row = (4 * edge).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
        let read = self.gpu.room(u64::from(row) * u64::from(edge), usage);
        let mut all = Vec::with_capacity(eyes.len());
        for eyes in eyes.chunks((self.columns * self.columns) as usize) {
            let mut encoder = self.rasterise(eyes);
            let layout = wgpu::TexelCopyBufferLayout { bytes_per_row: Some(row), ..Default::default() };
            let to = wgpu::TexelCopyBufferInfo { buffer: &read, layout };
            encoder.copy_texture_to_buffer(self.seen.as_image_copy(), to, self.seen.size());
            let told: Vec<u32> = self.told(encoder, &read)?;
            all.extend((0..eyes.len()).map(|record| {
                let [left, top] = [record % self.columns as usize, record / self.columns as usize].map(|at| at * size);
                let start = |y: usize| (top + y) * (row / 4) as usize + left;
                (0..size).flat_map(|y| told[start(y)..start(y) + size].iter().copied()).collect()
            }));
        }
        Ok(all)
    }

    /// Draws the planes of as many eyes as there is room for.
    fn rasterise(&self, eyes: &[Eye]) -> wgpu::CommandEncoder {
        self.gpu.queue.write_buffer(&self.eyes, 0, bytemuck::cast_slice(eyes));
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let view = self.seen.create_view(&Default::default());
        let seen = wgpu::RenderPassColorAttachment {
            view: &view,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
        };
        let depth = wgpu::RenderPassDepthStencilAttachment {
            view: &self.depth,
            depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
            stencil_ops: None,
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(seen)],
            depth_stencil_attachment: Some(depth),
            ..Default::default()
        });
        pass.set_pipeline(&self.draw);
        pass.set_bind_group(0, &self.bound[0], &[]);
        for record in 0..eyes.len() as u32 {
            let (left, top) = (record % self.columns * self.size, record / self.columns * self.size);
            pass.set_viewport(left as f32, top as f32, self.size as f32, self.size as f32, 0.0, 1.0);
            pass.set_scissor_rect(left, top, self.size, self.size);
            pass.draw(0..self.corners, record..record + 1);
        }
        drop(pass);
        encoder
    }

    /// What a buffer holds when all is done.
    fn told<T: bytemuck::Pod>(&self, encoder: wgpu::CommandEncoder, read: &wgpu::Buffer) -> Result<Vec<T>, Lost> {
        self.gpu.queue.submit([encoder.finish()]);
        read.map_async(wgpu::MapMode::Read, .., |_| {});
        self.gpu.wait()?;
        let mapped = read.get_mapped_range(..).map_err(|e| Lost(format!("{}: {e}", self.gpu.name)))?;
        let told = pod_collect_to_vec(&mapped[..]);
        drop(mapped);
        read.unmap();
        Ok(told)
    }
}

fn source(size: u32, columns: u32, cells: u32, pass: &str) -> String {
    let numbers =
        format!("const SIZE: u32 = {size}u;\nconst COLUMNS: u32 = {columns}u;\nconst CELLS: u32 = {cells}u;\n");
    format!("{numbers}const HALF: f32 = {HALF:?};\n{PLANE}{pass}")
}

fn draw(gpu: &Gpu, module: &wgpu::ShaderModule) -> wgpu::RenderPipeline {
    gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: None,
        layout: None,
        vertex: wgpu::VertexState {
            module,
            entry_point: Some("project"),
            compilation_options: Default::default(),
            buffers: &[],
        },
        primitive: Default::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Greater),
            stencil: Default::default(),
            bias: Default::default(),
        }),
        multisample: Default::default(),
        fragment: Some(wgpu::FragmentState {
            module,
            entry_point: Some("rasterise"),
            compilation_options: Default::default(),
            targets: &[Some(SEEN.into())],
        }),
        multiview_mask: None,
        cache: None,
    })
}

fn bind(gpu: &Gpu, layout: &wgpu::BindGroupLayout, bound: Vec<wgpu::BindingResource>) -> wgpu::BindGroup {
    let entry = |(binding, resource)| wgpu::BindGroupEntry { binding, resource };
    let entries: Vec<_> = (0..).zip(bound).map(entry).collect();
    gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use wgpu::naga::{TypeInner, front::wgsl, valid};

    use super::*;

    /// On machines without a graphics adapter too.
    #[test]
    fn shaders_are_sound_and_see_eyes_as_rust_does() {
        for pass in [RASTERISE, INTEGRATE] {
            let source = source(64, 16, 64, pass);
            let module = wgsl::parse_str(&source).unwrap_or_else(|e| panic!("{}", e.emit_to_string(&source)));
            let mut validator = valid::Validator::new(valid::ValidationFlags::all(), valid::Capabilities::empty());
            validator.validate(&module).expect("it is sound");
            let eye = module.types.iter().find(|(_, t)| t.name.as_deref() == Some("Eye")).expect("it is there").1;
            let TypeInner::Struct { members, span } = &eye.inner else { panic!("no struct") };
            let offset =
                |name: &str| members.iter().find(|m| m.name.as_deref() == Some(name)).map(|m| m.offset as usize);
            assert_eq!(
                (offset("position"), offset("near")),
                (Some(offset_of!(Eye, position)), Some(offset_of!(Eye, near)))
            );
            assert_eq!(["x", "y", "z"].map(offset), [16, 32, 48].map(Some));
            assert_eq!(*span as usize, size_of::<Eye>());
        }
    }
}
