//! Sealed records on a device, and points of a picture that ask them.

use std::collections::BTreeMap;
use std::f32::consts::FRAC_1_PI;
use std::sync::Arc;
use std::time::Instant;

use cache_core::{of_order, radiance};
use glam::Vec3;
use worker::levels::{Level, Reflected};
use worker::lobes::Served;
use worker::settings::Settings;
use worker::splat::{Look, Lost, Splat};

use crate::device::Gpu;
use crate::layout::{Answer, IRRADIANCE, Point, Site, Splats, View};
use crate::passes::{self, Draw, SUMS_FORMAT};
use crate::reach::reach;

/// Edge of the tiles that a group of threads has.
const TILE: u32 = 16;

/// Bytes of a pixel in the largest buffer that has one for each: three sums.
const PIXEL_BYTES: u64 = 48;

/// Records drawn onto the pixels of one picture.
pub struct Splatter {
    gpu: Arc<Gpu>,
    settings: Settings,
    kinds: BTreeMap<u32, Kind>,
    normalise: wgpu::ComputePipeline,
    region: Option<Region>,
    /// Bytes one buffer may have.
    most: u64,
    device_seconds: f64,
}

/// Records of one kind.
struct Kind {
    draw: Draw,
    /// Tables of rotations, for records of radiance.
    tilts: Option<[wgpu::Buffer; 2]>,
    chunks: Vec<Chunk>,
}

/// As many records as a binding holds.
struct Chunk {
    sites: wgpu::Buffer,
    values: wgpu::Buffer,
    count: u32,
    /// Where they lie, for devices that do not blend.
    known: Vec<Site>,
}

/// Buffers for a part of a picture.
struct Region {
    size: [u32; 2],
    points: wgpu::Buffer,
    answers: wgpu::Buffer,
    read: wgpu::Buffer,
    sums: Summed,
}

/// Where sums are.
enum Summed {
    Blended(Box<[wgpu::TextureView; 3]>),
    Stored(wgpu::Buffer),
}

impl Splatter {
    /// One for a picture, without records.
    pub fn new(gpu: Arc<Gpu>, settings: &Settings) -> Self {
        let (normalise, most) = (passes::normalise(&gpu), gpu.binding_max());
        Self {
            gpu,
            settings: settings.clone(),
            kinds: BTreeMap::new(),
            normalise,
            region: None,
            most,
            device_seconds: 0.0,
        }
    }

    /// The same with buffers of at most so many bytes.
    #[must_use]
    pub fn with_buffers_of(self, most: u64) -> Self {
        Self { most, ..self }
    }

    /// Seconds the device worked on the last answers.
    pub fn device_seconds(&self) -> f64 {
        self.device_seconds
    }

    /// Takes the records of a level in place of those it has.
    pub fn load(&mut self, level: &Level) {
        self.take(Splats::of(level));
    }

    /// Takes records in place of those it has.
    pub fn take(&mut self, splats: Vec<Splats>) {
        self.kinds.values_mut().for_each(|kind| kind.chunks.clear());
        for splats in splats {
            let kind = self.kinds.entry(splats.kind).or_insert_with(|| Kind {
                draw: Draw::new(&self.gpu, splats.kind),
                tilts: passes::tilts(&self.gpu, splats.kind),
                chunks: Vec::new(),
            });
            let each = size_of::<Site>().max(4 * splats.stride());
            let most = (self.most as usize / each).max(1);
            let chunks = splats.sites.chunks(most).zip(splats.values.chunks(most * splats.stride()));
            kind.chunks = chunks
                .map(|(sites, values)| Chunk {
                    sites: self.gpu.buffer(bytemuck::cast_slice(sites), wgpu::BufferUsages::STORAGE),
                    values: self.gpu.buffer(bytemuck::cast_slice(values), wgpu::BufferUsages::STORAGE),
                    count: sites.len() as u32,
                    known: if self.gpu.blends { Vec::new() } else { sites.to_vec() },
                })
                .collect();
        }
    }

    /// What each of the points of a region (columns `x0` to `x1`, rows `y0` to `y1`, exclusive), row by row, is told. `lobes`: of
    /// each order, the coefficients of the points' lobes, channel by channel.
    ///
    /// # Errors
    /// [`Lost`]: the device has gone.
    pub fn draw(
        &mut self,
        region: [u32; 4],
        points: &[Point],
        lobes: &BTreeMap<u32, Vec<f32>>,
    ) -> Result<Vec<Answer>, Lost> {
        let view = View::new(&self.settings, region);
        let size = [view.width, view.height];
        if self.region.as_ref().is_none_or(|region| region.size != size) {
            self.region = Some(Region::new(&self.gpu, size));
        }
        let Some(region) = &self.region else { return Ok(Vec::new()) };
        let gpu = &*self.gpu;
        gpu.queue.write_buffer(&region.points, 0, bytemuck::cast_slice(points));
        let uniform = gpu.buffer(bytemuck::bytes_of(&view), wgpu::BufferUsages::UNIFORM);
        let mut wanted: Vec<u32> = points.iter().map(|p| p.kind).filter(|kind| *kind != 0).collect();
        wanted.sort_unstable();
        wanted.dedup();
        let mut work = Vec::new();
        for kind in self.kinds.iter().filter(|(kind, _)| wanted.binary_search(kind).is_ok()) {
            let rotation = self.rotation(kind, lobes);
            work.extend(kind.1.chunks.iter().map(|chunk| (&kind.1.draw, chunk, rotation.clone())));
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        match &region.sums {
            Summed::Blended(targets) => self.blend(&mut encoder, targets, (region, &uniform), &work),
            Summed::Stored(sums) => {
                encoder.clear_buffer(sums, 0, None);
                for step in &work {
                    self.sum(&mut encoder, sums, (region, &view, &uniform), step);
                }
            }
        }
        let mut bound = vec![(0, uniform.as_entire_binding()), (1, region.answers.as_entire_binding())];
        match &region.sums {
            Summed::Blended(views) => {
                bound.extend((2..).zip(views.iter()).map(|(at, view)| (at, wgpu::BindingResource::TextureView(view))));
            }
            Summed::Stored(sums) => bound.push((2, sums.as_entire_binding())),
        }
        let bound = self.bind(&self.normalise.get_bind_group_layout(0), bound);
        {
            let mut pass = encoder.begin_compute_pass(&Default::default());
            pass.set_pipeline(&self.normalise);
            pass.set_bind_group(0, &bound, &[]);
            pass.dispatch_workgroups(size[0].div_ceil(TILE), size[1].div_ceil(TILE), 1);
        }
        encoder.copy_buffer_to_buffer(&region.answers, 0, &region.read, 0, region.read.size());
        gpu.queue.submit([encoder.finish()]);
        region.read.map_async(wgpu::MapMode::Read, .., |_| {});
        let start = Instant::now();
        gpu.wait()?;
        self.device_seconds += start.elapsed().as_secs_f64();
        let mapped = region.read.get_mapped_range(..).map_err(|e| Lost(format!("{}: {e}", gpu.name)))?;
        let answers = bytemuck::pod_collect_to_vec(&mapped[..]);
        drop(mapped);
        region.read.unmap();
        Ok(answers)
    }

    /// The bindings by which records of radiance rotate and are reflected.
    fn rotation(&self, (kind, of): (&u32, &Kind), lobes: &BTreeMap<u32, Vec<f32>>) -> Option<wgpu::BindGroup> {
        let [tilts, index] = of.tilts.as_ref()?;
        let lobes = lobes.get(kind).map_or(&[][..], Vec::as_slice);
        let lobes = self.gpu.buffer(bytemuck::cast_slice(lobes), wgpu::BufferUsages::STORAGE);
        let bound = [tilts, index, &lobes].map(wgpu::Buffer::as_entire_binding);
        Some(self.bind(&of.draw.layout(1), (0..).zip(bound).collect()))
    }

    fn bind(&self, layout: &wgpu::BindGroupLayout, bound: Vec<(u32, wgpu::BindingResource)>) -> wgpu::BindGroup {
        let entry = |(binding, resource)| wgpu::BindGroupEntry { binding, resource };
        let entries: Vec<_> = bound.into_iter().map(entry).collect();
        self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
    }

    fn blend(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        targets: &[wgpu::TextureView; 3],
        (region, uniform): (&Region, &wgpu::Buffer),
        work: &[(&Draw, &Chunk, Option<wgpu::BindGroup>)],
    ) {
        let attachment = |view| {
            let ops =
                wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store };
            Some(wgpu::RenderPassColorAttachment { view, depth_slice: None, resolve_target: None, ops })
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &targets.each_ref().map(attachment),
            ..Default::default()
        });
        for (draw, chunk, rotation) in work {
            let Draw::Blend(pipeline) = draw else { continue };
            let bound = [uniform, &chunk.sites, &chunk.values, &region.points].map(wgpu::Buffer::as_entire_binding);
            pass.set_pipeline(pipeline);
            pass.set_bind_group(0, &self.bind(&draw.layout(0), (0..).zip(bound).collect()), &[]);
            if let Some(rotation) = rotation {
                pass.set_bind_group(1, rotation, &[]);
            }
            pass.draw(0..4, 0..chunk.count);
        }
    }

    fn sum(
        &self,
        encoder: &mut wgpu::CommandEncoder,
        sums: &wgpu::Buffer,
        (region, view, uniform): (&Region, &View, &wgpu::Buffer),
        (draw, chunk, rotation): &(&Draw, &Chunk, Option<wgpu::BindGroup>),
    ) {
        let Draw::Sum(pipeline) = draw else { return };
        let (tiles, reached) = reached(view, &chunk.known);
        let storage = |list: &[u32]| self.gpu.buffer(bytemuck::cast_slice(list), wgpu::BufferUsages::STORAGE);
        let (tiles, reached) = (storage(&tiles), storage(&reached));
        let bound = [uniform, &chunk.sites, &chunk.values, &region.points, &tiles, &reached, sums];
        let bound = (0..).zip(bound.map(wgpu::Buffer::as_entire_binding)).collect();
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(pipeline);
        pass.set_bind_group(0, &self.bind(&draw.layout(0), bound), &[]);
        if let Some(rotation) = rotation {
            pass.set_bind_group(1, rotation, &[]);
        }
        pass.dispatch_workgroups(view.width.div_ceil(TILE), view.height.div_ceil(TILE), 1);
    }
}

/// Of each tile of a region where the records that reach it begin in the list of all that reach any, and that list.
fn reached(view: &View, sites: &[Site]) -> (Vec<u32>, Vec<u32>) {
    let (columns, rows) = (view.width.div_ceil(TILE), view.height.div_ceil(TILE));
    let mut of_tile = vec![Vec::new(); (columns * rows) as usize];
    for (record, site) in (0..).zip(sites) {
        let [left, top, right, bottom] = reach(view, site).to_array().map(|v| v as u32);
        if right > left {
            for row in top / TILE..bottom.div_ceil(TILE) {
                (left / TILE..right.div_ceil(TILE)).for_each(|x| of_tile[(row * columns + x) as usize].push(record));
            }
        }
    }
    let mut starts = vec![0];
    starts.extend(of_tile.iter().scan(0, |end, tile| {
        *end += tile.len() as u32;
        Some(*end)
    }));
    (starts, of_tile.concat())
}

impl Region {
    fn new(gpu: &Gpu, size: [u32; 2]) -> Self {
        let pixels = u64::from(size[0]) * u64::from(size[1]);
        let (storage, from, to) =
            (wgpu::BufferUsages::STORAGE, wgpu::BufferUsages::COPY_SRC, wgpu::BufferUsages::COPY_DST);
        let answers = pixels * size_of::<Answer>() as u64;
        let target = || {
            let texture = gpu.device.create_texture(&wgpu::TextureDescriptor {
                label: None,
                size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: SUMS_FORMAT,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING,
                view_formats: &[],
            });
            texture.create_view(&Default::default())
        };
        Self {
            size,
            points: gpu.room(pixels * size_of::<Point>() as u64, storage | to),
            answers: gpu.room(answers, storage | from),
            read: gpu.room(answers, wgpu::BufferUsages::MAP_READ | to),
            sums: if gpu.blends {
                Summed::Blended(Box::new([target(), target(), target()]))
            } else {
                Summed::Stored(gpu.room(pixels * PIXEL_BYTES, storage | to))
            },
        }
    }
}

impl Splat for Splatter {
    fn answers(&mut self, looks: &mut dyn Iterator<Item = &Look>) -> Result<Vec<Option<Reflected>>, Lost> {
        self.device_seconds = 0.0;
        let looks: Vec<&Look> = looks.collect();
        let mut answers = vec![None; looks.len()];
        let [mut columns, mut rows] = [(u32::MAX, 0); 2];
        for look in &looks {
            let [x, y] = look.pixel;
            columns = (columns.0.min(x), columns.1.max(x + 1));
            rows = (rows.0.min(y), rows.1.max(y + 1));
        }
        if looks.is_empty() {
            return Ok(answers);
        }
        let order = |look: &Look| if let Served::Gloss(order, _) = look.served { order } else { 0 };
        let order = looks.iter().map(|look| order(look)).max().unwrap_or(0) as u64;
        let of_row = u64::from(columns.1 - columns.0) * PIXEL_BYTES.max(12 * order * order);
        let height = u32::try_from(self.most / of_row).unwrap_or(u32::MAX).max(1);
        let mut by_band = BTreeMap::<u32, Vec<usize>>::new();
        for (i, look) in looks.iter().enumerate() {
            by_band.entry((look.pixel[1] - rows.0) / height).or_default().push(i);
        }
        for (band, own) in by_band {
            let top = rows.0 + band * height;
            let region = [columns.0, columns.1, top, rows.1.min(top.saturating_add(height))];
            let told = self.band(region, &own.iter().map(|i| looks[*i]).collect::<Vec<_>>())?;
            own.into_iter().zip(told).for_each(|(i, told)| answers[i] = told);
        }
        Ok(answers)
    }
}

impl Splatter {
    fn band(&mut self, region: [u32; 4], looks: &[&Look]) -> Result<Vec<Option<Reflected>>, Lost> {
        let [x0, x1, y0, y1] = region;
        let mut points = vec![bytemuck::Zeroable::zeroed(); ((x1 - x0) * (y1 - y0)) as usize];
        let mut lobes = BTreeMap::<u32, Vec<f32>>::new();
        let at = |look: &Look| ((look.pixel[1] - y0) * (x1 - x0) + look.pixel[0] - x0) as usize;
        for look in looks {
            points[at(look)] = match &look.served {
                Served::Diffuse(_) => Point::new(&look.query, IRRADIANCE, 0),
                Served::Gloss(order, reflection) => {
                    let own = lobes.entry(*order as u32).or_default();
                    let lobe = (own.len() / (3 * order * order)) as u32;
                    of_order!(*order, N => own.extend_from_slice(reflection.coefficients::<N>().as_flattened()));
                    Point::new(&look.query, *order as u32, lobe)
                }
            };
        }
        let answers = self.draw(region, &points, &lobes)?;
        Ok(looks.iter().map(|look| reflected(&answers[at(look)], &look.served)).collect())
    }
}

/// What is reflected, as `worker::levels` makes it of an answer.
fn reflected(answer: &Answer, served: &Served) -> Option<Reflected> {
    if answer.records == 0.0 {
        return None;
    }
    let (irradiance, radiance) = (Vec3::from(answer.irradiance), Vec3::from(answer.radiance));
    let records = answer.records as u32;
    Some(match served {
        Served::Diffuse(albedo) => Reflected {
            radiance: *albedo * irradiance * FRAC_1_PI,
            irradiance,
            records,
            noise: answer.noise * albedo.length() * (FRAC_1_PI / 3f32.sqrt()),
        },
        Served::Gloss(order, reflection) => {
            let gain = of_order!(*order, N => radiance::gain(&reflection.coefficients::<N>())).unwrap_or(0.0);
            let (radiance, irradiance) = (radiance.max(Vec3::ZERO), irradiance.max(Vec3::ZERO));
            Reflected { radiance, irradiance, records, noise: gain * answer.noise }
        }
    })
}
