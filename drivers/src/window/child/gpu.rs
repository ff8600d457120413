//! The GPU: slides as textures, and one of them on the surface.

use std::{
    sync::{Arc, Mutex, PoisonError},
    task::{Context, Poll, Waker},
};

use wgpu::{CurrentSurfaceTexture as Acquired, TextureFormat};
use winit::window::Window;

use crate::{
    projector::{Rgb, Slide},
    window::protocol::{Asked, Fault},
};

/// Formats that pass on code values as they are. What ends in `Srgb` would encode them a second time.
const FORMATS: [TextureFormat; 2] = [TextureFormat::Bgra8Unorm, TextureFormat::Rgba8Unorm];

/// How often a picture is tried again before it is given up.
const TRIES: usize = 4;

/// What became of the device behind our back.
#[derive(Debug, Default)]
struct Trouble {
    /// The last error that no call returned.
    error: Option<String>,
    /// Why the device is lost, if it is.
    lost: Option<String>,
}

/// Surface, device and slides.
pub struct Gpu {
    instance: wgpu::Instance,
    window: Arc<Window>,
    /// `None` only while it is made anew.
    surface: Option<wgpu::Surface<'static>>,
    config: wgpu::SurfaceConfiguration,
    device: wgpu::Device,
    queue: wgpu::Queue,
    layout: wgpu::BindGroupLayout,
    pipeline: wgpu::RenderPipeline,
    black: wgpu::BindGroup,
    slides: Vec<wgpu::BindGroup>,
    trouble: Arc<Mutex<Trouble>>,
    adapter: String,
}

/// What to do with the answer to the question for the next picture of the swapchain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Ask again.
    Again,
    /// Configure the surface, then ask again.
    Configure,
    /// Make the surface anew, then ask again.
    Renew,
    /// Give up.
    Give,
}

/// An answer without a picture, in one word, and the step after it.
fn after(acquired: &Acquired) -> (&'static str, Step) {
    match acquired {
        Acquired::Success(_) => ("success", Step::Again),
        // The surface has another size or form by now: pictures on it would be scaled.
        Acquired::Suboptimal(_) => ("suboptimal", Step::Configure),
        Acquired::Timeout => ("timeout", Step::Again),
        Acquired::Occluded => ("occluded", Step::Give),
        Acquired::Outdated => ("outdated", Step::Configure),
        Acquired::Lost => ("lost", Step::Renew),
        Acquired::Validation => ("validation error", Step::Give),
    }
}

impl Gpu {
    /// Opens the GPU that can show pictures in `window`.
    pub fn new(window: Arc<Window>, width: u32, height: u32) -> Result<Self, Fault> {
        let unavailable = |what: &str, error: &dyn std::fmt::Display| {
            let next = "install a Vulkan driver, for example the package mesa-vulkan-drivers";
            Fault::Unavailable(format!("{what}: {error}; {next}"))
        };
        let mut options = wgpu::InstanceDescriptor::new_without_display_handle();
        options.backends = wgpu::Backends::VULKAN;
        let instance = wgpu::Instance::new(options);
        let surface = instance
            .create_surface(window.clone())
            .map_err(|error| unavailable("there is no Vulkan surface for the window", &error))?;
        let adapter = now(instance.request_adapter(&wgpu::RequestAdapterOptions {
            compatible_surface: Some(&surface),
            ..Default::default()
        }))
        .map_err(|error| unavailable("no GPU can show pictures in the window", &error))?;
        let limits = adapter.limits();
        if width.max(height) > limits.max_texture_dimension_2d {
            return Err(Fault::Refused {
                what: Asked::Size,
                requested: format!("{width} x {height}"),
                offered: format!("at most {} per side on this GPU", limits.max_texture_dimension_2d),
            });
        }
        let (device, queue) = now(adapter.request_device(&wgpu::DeviceDescriptor {
            required_limits: wgpu::Limits {
                max_texture_dimension_2d: limits.max_texture_dimension_2d,
                ..wgpu::Limits::downlevel_defaults()
            },
            ..Default::default()
        }))
        .map_err(|error| unavailable("the GPU cannot be opened", &error))?;
        let trouble = Arc::new(Mutex::new(Trouble::default()));
        let told = trouble.clone();
        device.on_uncaptured_error(Arc::new(move |error| lock(&told).error = Some(error.to_string())));
        let told = trouble.clone();
        device.set_device_lost_callback(move |reason, text| {
            lock(&told).lost = Some(format!("{reason:?} {text}").trim().to_owned());
        });
        let offered = surface.get_capabilities(&adapter);
        let config = configuration(&offered, width, height)?;
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("picture"),
            entries: &[wgpu::BindGroupLayoutEntry {
                binding: 0,
                visibility: wgpu::ShaderStages::FRAGMENT,
                ty: wgpu::BindingType::Texture {
                    sample_type: wgpu::TextureSampleType::Float { filterable: false },
                    view_dimension: wgpu::TextureViewDimension::D2,
                    multisampled: false,
                },
                count: None,
            }],
        });
        let pipeline = pipeline(&device, &layout, config.format);
        let black = bind(&device, &queue, &layout, &Slide::Uniform([0; 3]), width, height);
        let info = adapter.get_info();
        let adapter = format!("{} ({} {})", info.name, info.driver, info.driver_info);
        surface.configure(&device, &config);
        let gpu = Self {
            instance,
            window,
            surface: Some(surface),
            config,
            device,
            queue,
            layout,
            pipeline,
            black,
            slides: Vec::new(),
            trouble,
            adapter,
        };
        gpu.troubled()?;
        Ok(gpu)
    }

    /// GPU and driver.
    pub fn adapter(&self) -> &str {
        &self.adapter
    }

    /// Format of the surface.
    pub fn format(&self) -> String {
        format!("{:?}", self.config.format)
    }

    /// Whether the device is lost, and everything must be made anew.
    pub fn is_lost(&self) -> bool {
        lock(&self.trouble).lost.is_some()
    }

    /// Brings all slides to the GPU; from then on a picture is one command.
    pub fn load(&mut self, slides: &[Slide]) -> Result<(), Fault> {
        let (width, height) = (self.config.width, self.config.height);
        let bound = |slide| bind(&self.device, &self.queue, &self.layout, slide, width, height);
        self.slides = slides.iter().map(bound).collect();
        self.queue.submit([]);
        let uploaded = self.device.poll(wgpu::PollType::wait_indefinitely());
        uploaded.map_err(|error| Fault::Broken(format!("the GPU did not take the slides: {error}")))?;
        self.troubled()
    }

    /// Draws a slide, or black, and hands it to the display.
    pub fn present(&mut self, slide: Option<u32>) -> Result<(), Fault> {
        let loaded = self.slides.len();
        let exists = slide.is_none_or(|slide| (slide as usize) < loaded);
        if !exists {
            return Err(Fault::Refused {
                what: Asked::Slide,
                requested: slide.unwrap_or_default().to_string(),
                offered: format!("{loaded} slides, numbered from 0"),
            });
        }
        let picture = self.acquire()?;
        let view = picture.texture.create_view(&Default::default());
        let mut commands = self.device.create_command_encoder(&Default::default());
        {
            let mut pass = commands.begin_render_pass(&wgpu::RenderPassDescriptor {
                color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                    view: &view,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations {
                        load: wgpu::LoadOp::Clear(wgpu::Color::BLACK),
                        store: wgpu::StoreOp::Store,
                    },
                })],
                ..Default::default()
            });
            pass.set_pipeline(&self.pipeline);
            pass.set_bind_group(0, slide.map_or(&self.black, |slide| &self.slides[slide as usize]), &[]);
            pass.draw(0..3, 0..1);
        }
        self.queue.submit([commands.finish()]);
        self.queue.present(picture);
        self.troubled()
    }

    /// The next picture of the swapchain, of the right size.
    fn acquire(&mut self) -> Result<wgpu::SurfaceTexture, Fault> {
        let mut said = Vec::new();
        for _ in 0..TRIES {
            let Some(surface) = &self.surface else { break };
            let acquired = surface.get_current_texture();
            self.troubled()?;
            let (name, step) = after(&acquired);
            if let Acquired::Success(picture) = acquired {
                let size = (picture.texture.width(), picture.texture.height());
                if size == (self.config.width, self.config.height) {
                    return Ok(picture);
                }
                said.push("another size");
                continue;
            }
            said.push(name);
            // A picture that does not fit goes back before the surface may be configured.
            drop(acquired);
            match step {
                Step::Again => {}
                Step::Configure => surface.configure(&self.device, &self.config),
                Step::Renew => self.renew()?,
                Step::Give => break,
            }
        }
        Err(Fault::Unavailable(format!(
            "the display takes no picture ({}); see whether the window is on it and nothing covers it",
            said.join(", ")
        )))
    }

    /// Makes the surface anew on the same device.
    fn renew(&mut self) -> Result<(), Fault> {
        // Of one window there can be one surface.
        self.surface = None;
        let surface = self.instance.create_surface(self.window.clone()).map_err(|error| {
            Fault::Unavailable(format!("the surface was lost and cannot be made anew: {error}"))
        })?;
        surface.configure(&self.device, &self.config);
        self.surface = Some(surface);
        Ok(())
    }

    /// What the GPU complained of since the last call.
    fn troubled(&self) -> Result<(), Fault> {
        let mut trouble = lock(&self.trouble);
        if let Some(reason) = &trouble.lost {
            return Err(Fault::Unavailable(format!("the GPU was lost ({reason}); it is opened again")));
        }
        trouble.error.take().map_or(Ok(()), |error| Err(Fault::Broken(format!("the GPU says: {error}"))))
    }
}

fn lock(trouble: &Mutex<Trouble>) -> std::sync::MutexGuard<'_, Trouble> {
    trouble.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The result of one of the GPU's futures, which are ready at once on every system that has threads.
fn now<T>(future: impl Future<Output = T>) -> T {
    let mut future = std::pin::pin!(future);
    let mut context = Context::from_waker(Waker::noop());
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut context) {
            return value;
        }
        std::thread::yield_now();
    }
}

/// The configuration that passes on code values, waits for the refresh, and queues as little as possible.
fn configuration(
    offered: &wgpu::SurfaceCapabilities,
    width: u32,
    height: u32,
) -> Result<wgpu::SurfaceConfiguration, Fault> {
    let format = FORMATS.into_iter().find(|format| offered.formats.contains(format)).ok_or_else(|| {
        Fault::Refused {
            what: Asked::Format,
            requested: format!("{FORMATS:?}"),
            offered: format!("{:?}", offered.formats),
        }
    })?;
    let opaque = offered.alpha_modes.contains(&wgpu::CompositeAlphaMode::Opaque);
    Ok(wgpu::SurfaceConfiguration {
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
        format,
        color_space: Default::default(),
        width,
        height,
        present_mode: wgpu::PresentMode::Fifo,
        desired_maximum_frame_latency: 1,
        // Alpha is 1 everywhere, so that every mode shows the same; opaque is the one that says so.
        alpha_mode: if opaque { wgpu::CompositeAlphaMode::Opaque } else { wgpu::CompositeAlphaMode::Auto },
        view_formats: Vec::new(),
    })
}

fn pipeline(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    format: TextureFormat,
) -> wgpu::RenderPipeline {
    let shader = device.create_shader_module(wgpu::include_wgsl!("picture.wgsl"));
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some("picture"),
        bind_group_layouts: &[Some(layout)],
        immediate_size: 0,
    });
    device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: Some("picture"),
        layout: Some(&layout),
        vertex: wgpu::VertexState {
            module: &shader,
            entry_point: Some("whole_surface"),
            compilation_options: Default::default(),
            buffers: &[],
        },
        primitive: Default::default(),
        depth_stencil: None,
        multisample: Default::default(),
        fragment: Some(wgpu::FragmentState {
            module: &shader,
            entry_point: Some("texel"),
            compilation_options: Default::default(),
            targets: &[Some(wgpu::ColorTargetState {
                format,
                blend: None,
                write_mask: wgpu::ColorWrites::ALL,
            })],
        }),
        multiview_mask: None,
        cache: None,
    })
}

/// A slide as a texture: of one row where it has values per column, of one column where it has values per row.
fn bind(
    device: &wgpu::Device,
    queue: &wgpu::Queue,
    layout: &wgpu::BindGroupLayout,
    slide: &Slide,
    width: u32,
    height: u32,
) -> wgpu::BindGroup {
    let (columns, rows, values): (u32, u32, &[Rgb]) = match slide {
        Slide::Uniform(value) => (1, 1, std::slice::from_ref(value)),
        Slide::Columns(values) => (width, 1, values),
        Slide::Rows(values) => (1, height, values),
        Slide::Full(values) => (width, height, values),
    };
    let texels: Vec<u8> = values.iter().flat_map(|[red, green, blue]| [*red, *green, *blue, 255]).collect();
    let size = wgpu::Extent3d { width: columns, height: rows, depth_or_array_layers: 1 };
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: Some("slide"),
        size,
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: TextureFormat::Rgba8Unorm,
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    });
    let rows =
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * columns), rows_per_image: None };
    queue.write_texture(texture.as_image_copy(), &texels, rows, size);
    device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("slide"),
        layout,
        entries: &[wgpu::BindGroupEntry {
            binding: 0,
            resource: wgpu::BindingResource::TextureView(&texture.create_view(&Default::default())),
        }],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offered(formats: &[TextureFormat]) -> wgpu::SurfaceCapabilities {
        wgpu::SurfaceCapabilities {
            formats: formats.to_vec(),
            alpha_modes: vec![wgpu::CompositeAlphaMode::Inherit, wgpu::CompositeAlphaMode::Opaque],
            ..Default::default()
        }
    }

    #[test]
    fn a_format_that_encodes_code_values_again_is_never_taken() {
        use TextureFormat::{Bgra8Unorm, Bgra8UnormSrgb, Rgba8Unorm, Rgba8UnormSrgb, Rgba16Float};
        let taken = |formats: &[_]| configuration(&offered(formats), 4, 3).map(|config| config.format);
        // In the order of lavapipe, and of drivers that have the other order of channels.
        assert_eq!(taken(&[Bgra8UnormSrgb, Bgra8Unorm]), Ok(Bgra8Unorm));
        assert_eq!(taken(&[Rgba8UnormSrgb, Rgba8Unorm]), Ok(Rgba8Unorm));
        let refused = taken(&[Bgra8UnormSrgb, Rgba16Float]).expect_err("neither passes on codes");
        assert!(matches!(refused, Fault::Refused { what: Asked::Format, .. }), "{refused:?}");
    }

    #[test]
    fn nothing_is_queued_or_blended() {
        let config = configuration(&offered(&FORMATS), 801, 603).expect("a configuration");
        assert_eq!((config.width, config.height), (801, 603));
        assert_eq!(config.alpha_mode, wgpu::CompositeAlphaMode::Opaque);
        assert_eq!(config.present_mode, wgpu::PresentMode::Fifo);
        assert_eq!(config.desired_maximum_frame_latency, 1);
        assert!(config.view_formats.is_empty());
    }

    #[test]
    fn every_answer_without_a_picture_has_its_step() {
        let steps =
            [Acquired::Timeout, Acquired::Occluded, Acquired::Outdated, Acquired::Lost, Acquired::Validation]
                .map(|acquired| after(&acquired).1);
        assert_eq!(steps, [Step::Again, Step::Give, Step::Configure, Step::Renew, Step::Give]);
    }
}
