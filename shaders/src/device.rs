//! The adapter records are drawn with.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use worker::splat::Lost;

/// Floats blended as they are.
const BLENDABLE: wgpu::Features = wgpu::Features::FLOAT32_BLENDABLE;

/// How long work may take: a processor that draws a hundred thousand records on the largest picture needs 15 s.
const PATIENCE: Duration = Duration::from_secs(120);

/// A device, ready to be given work.
pub struct Gpu {
    /// What makes buffers and pipelines.
    pub device: wgpu::Device,
    /// What takes work.
    pub queue: wgpu::Queue,
    /// Name of adapter and driver, for people.
    pub name: String,
    /// Whether it can add floats to a picture; else records are summed by a compute pass.
    pub blends: bool,
    trouble: Arc<Mutex<Option<String>>>,
}

impl Gpu {
    /// The fastest adapter there is; with Mesa's lavapipe that may be the processor. `blend` false: as if it could not add
    /// floats to a picture.
    ///
    /// # Errors
    /// [`Lost`]: there is none, or it gives no device.
    pub fn new(blend: bool) -> Result<Self, Lost> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let options = wgpu::RequestAdapterOptions {
            power_preference: wgpu::PowerPreference::HighPerformance,
            ..Default::default()
        };
        let adapter = pollster::block_on(instance.request_adapter(&options));
        let adapter = adapter.map_err(|e| Lost(format!("there is no graphics adapter to splat with: {e}")))?;
        let about = adapter.get_info();
        let blends = blend && adapter.features().contains(BLENDABLE);
        let descriptor = wgpu::DeviceDescriptor {
            required_features: if blends { BLENDABLE } else { wgpu::Features::empty() },
            required_limits: adapter.limits(),
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|e| Lost(format!("the graphics adapter {} gives no device: {e}", about.name)))?;
        let trouble = Arc::new(Mutex::new(None));
        let (errors, losses) = (trouble.clone(), trouble.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| note(&errors, error.to_string())));
        device.set_device_lost_callback(move |_, why| note(&losses, format!("the device is lost: {why}")));
        let name = format!("{} ({})", about.name, if blends { "blending" } else { "computing" });
        Ok(Self { device, queue, name, blends, trouble })
    }

    /// Whether all went well so far.
    ///
    /// # Errors
    /// What the device complained of.
    pub fn check(&self) -> Result<(), Lost> {
        let trouble = self.trouble.lock().unwrap_or_else(PoisonError::into_inner);
        trouble.as_ref().map_or(Ok(()), |why| Err(Lost(format!("{}: {why}", self.name))))
    }

    /// Waits until all work given so far is done.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn wait(&self) -> Result<(), Lost> {
        let waited = self.device.poll(wgpu::PollType::Wait { submission_index: None, timeout: Some(PATIENCE) });
        // What it complained of says more.
        self.check()?;
        waited.map(drop).map_err(|e| Lost(format!("{}: no answer for {} s: {e}", self.name, PATIENCE.as_secs())))
    }

    /// A buffer that holds `content`, or four zeros where there is none: no binding may be empty.
    pub fn buffer(&self, content: &[u8], usage: wgpu::BufferUsages) -> wgpu::Buffer {
        let buffer = self.room(content.len().max(4) as u64, usage | wgpu::BufferUsages::COPY_DST);
        self.queue.write_buffer(&buffer, 0, content);
        buffer
    }

    /// A buffer of so many bytes, all 0.
    pub fn room(&self, size: u64, usage: wgpu::BufferUsages) -> wgpu::Buffer {
        self.device.create_buffer(&wgpu::BufferDescriptor { label: None, size, usage, mapped_at_creation: false })
    }

    /// Bytes one binding may have.
    pub fn binding_max(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size)
    }
}

fn note(trouble: &Mutex<Option<String>>, why: String) {
    // The first one; the rest follows from it.
    trouble.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(why);
}
