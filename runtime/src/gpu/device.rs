//! Which devices there are, opening one, and what goes wrong with them.
//!
//! A device is asked for as much storage as its adapter offers, because frames are large; a caller may force less,
//! which is how the limits are tested. Failures of a device come late and on other threads: error scopes around each
//! piece of work and the callback for a lost device turn them into a [`GpuError`] that names the remedy.

use std::future::Future;
use std::pin::pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

/// What is known of an adapter before it is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterSummary {
    /// The driver's name for it.
    pub name: String,
    /// `vulkan`, `metal` or `dx12`.
    pub backend: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    /// Driver and its version.
    pub driver: String,
    /// Bytes that a shader sees of one buffer.
    pub storage_binding: u64,
    /// Bytes of one buffer.
    pub buffer: u64,
    /// Whether passes can be timed.
    pub timestamps: bool,
}

impl AdapterSummary {
    /// True if it is a driver that computes on the processor.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }
}

/// Which adapter is meant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Choice {
    /// The fastest kind there is: discrete before integrated before the rest.
    Best,
    /// The first whose name contains this, whatever the case of its letters.
    Named(String),
}

/// Limits below those of the adapter.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ForcedLimits {
    /// Bytes that a shader sees of one buffer.
    pub storage_binding: Option<u64>,
}

/// Why a device cannot do what is asked.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// No adapter of this name, or none at all.
    #[error("device: found {found}, expected {expected}; use --device cpu, or one that `smoke-bake devices` lists")]
    NoDevice {
        /// What was asked for.
        expected: String,
        /// Names of the adapters.
        found: String,
    },
    /// The driver refuses to open it.
    #[error("device {name}: {reason}; use --device cpu, or update its driver")]
    Refused {
        /// The adapter.
        name: String,
        /// The driver's words.
        reason: String,
    },
    /// The device has no room for it, whatever is free.
    #[error("{what}: found {needed} bytes, expected at most {limit} on this device; use --device cpu")]
    Limit {
        /// What is too large.
        what: &'static str,
        /// Its size.
        needed: u64,
        /// The largest.
        limit: u64,
    },
    /// No memory is left.
    #[error("{stage}: the device is out of memory; close other programs that use it, or use --device cpu")]
    OutOfMemory {
        /// What it was doing.
        stage: &'static str,
    },
    /// The device went away.
    #[error("{stage}: the device was lost ({reason}); use --device cpu, or update its driver")]
    Lost {
        /// What it was doing.
        stage: &'static str,
        /// The driver's words.
        reason: String,
    },
    /// The driver or its validation refuses the work.
    #[error("{stage}: the device failed ({reason}); use --device cpu")]
    Failed {
        /// What it was doing.
        stage: &'static str,
        /// The words of the driver.
        reason: String,
    },
    /// The device's image of a known scene is wrong.
    #[error(
        "self-test: found an error of {found}, expected at most {expected}; use --device cpu, or update its driver"
    )]
    SelfTest {
        /// Largest difference.
        found: String,
        /// Largest that is allowed.
        expected: String,
    },
}

/// An open device.
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    summary: AdapterSummary,
    lost: Arc<Mutex<Option<String>>>,
    /// Microseconds of the stages that were dispatched, in their order.
    pub(super) times: Mutex<StageTimes>,
}

/// Microseconds on the device by stage, in the order of their first dispatch.
pub type StageTimes = Vec<(&'static str, f64)>;

/// All adapters, in the order in which [`Choice::Best`] prefers them.
pub fn adapters() -> Vec<AdapterSummary> {
    found().iter().map(summary).collect()
}

fn found() -> Vec<wgpu::Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let mut adapters = ready(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    adapters.retain(|a| a.get_downlevel_capabilities().flags.contains(wgpu::DownlevelFlags::COMPUTE_SHADERS));
    let rank = |kind: wgpu::DeviceType| match kind {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    };
    adapters.sort_by_key(|a| rank(a.get_info().device_type));
    adapters
}

fn summary(adapter: &wgpu::Adapter) -> AdapterSummary {
    described(&adapter.get_info(), &adapter.limits(), adapter.features())
}

fn described(info: &wgpu::AdapterInfo, limits: &wgpu::Limits, features: wgpu::Features) -> AdapterSummary {
    let kind = match info.device_type {
        wgpu::DeviceType::DiscreteGpu => "discrete",
        wgpu::DeviceType::IntegratedGpu => "integrated",
        wgpu::DeviceType::VirtualGpu => "virtual",
        wgpu::DeviceType::Cpu => "software",
        wgpu::DeviceType::Other => "other",
    };
    AdapterSummary {
        name: info.name.clone(),
        backend: info.backend.to_string(),
        kind,
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        storage_binding: limits.max_storage_buffer_binding_size,
        buffer: limits.max_buffer_size,
        timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
    }
}

impl Gpu {
    /// Opens an adapter. Limits of `forced` that are above the adapter's change nothing.
    pub fn open(choice: &Choice, forced: ForcedLimits) -> Result<Self, GpuError> {
        let all = found();
        let position = match choice {
            Choice::Best => (!all.is_empty()).then_some(0),
            Choice::Named(name) => {
                let wanted = name.to_lowercase();
                all.iter().position(|a| a.get_info().name.to_lowercase().contains(&wanted))
            }
        };
        let Some(position) = position else {
            let names: Vec<String> = all.iter().map(|a| a.get_info().name).collect();
            let found = if names.is_empty() { "no device".into() } else { names.join(", ") };
            let expected = match choice {
                Choice::Best => "any graphics device".into(),
                Choice::Named(name) => format!("one named like {name}"),
            };
            return Err(GpuError::NoDevice { expected, found });
        };
        let adapter = &all[position];
        let offered = adapter.limits();
        let binding = forced.storage_binding.unwrap_or(u64::MAX).min(offered.max_storage_buffer_binding_size);
        let required_limits = wgpu::Limits {
            max_storage_buffer_binding_size: binding,
            max_buffer_size: offered.max_buffer_size,
            ..wgpu::Limits::downlevel_defaults().using_resolution(offered.clone())
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("smoke"),
            required_features: adapter.features() & wgpu::Features::TIMESTAMP_QUERY,
            required_limits: wgpu::Limits { max_storage_buffers_per_shader_stage: 8, ..required_limits },
            ..Default::default()
        };
        let refused =
            |e: wgpu::RequestDeviceError| GpuError::Refused { name: adapter.get_info().name, reason: e.to_string() };
        let (device, queue) = ready(adapter.request_device(&descriptor)).map_err(refused)?;
        Ok(Self::from_parts(device, queue))
    }

    /// From a device and queue that a window has opened. It takes over the device's callback for loss.
    pub fn from_parts(device: wgpu::Device, queue: wgpu::Queue) -> Self {
        let lost = Arc::new(Mutex::new(None));
        let told = Arc::clone(&lost);
        device.set_device_lost_callback(move |reason, message| {
            if let Ok(mut lost) = told.lock() {
                *lost = Some(format!("{reason:?} {message}").trim().to_owned());
            }
        });
        let summary = described(&device.adapter_info(), &device.limits(), device.features());
        Self { device, queue, summary, lost, times: Mutex::default() }
    }

    /// The adapter, with the limits that hold for this device.
    pub fn summary(&self) -> &AdapterSummary {
        &self.summary
    }

    /// Device and queue, for passes of one's own.
    pub fn parts(&self) -> (&wgpu::Device, &wgpu::Queue) {
        (&self.device, &self.queue)
    }

    /// Does `work` and reports what the device said of it; `stage` is named in the error.
    pub fn checked<T>(&self, stage: &'static str, work: impl FnOnce() -> Result<T, GpuError>) -> Result<T, GpuError> {
        let scopes = [wgpu::ErrorFilter::Internal, wgpu::ErrorFilter::Validation, wgpu::ErrorFilter::OutOfMemory]
            .map(|filter| self.device.push_error_scope(filter));
        let done = work();
        // Scopes close in the opposite order.
        let mut error = None;
        for scope in scopes.into_iter().rev() {
            error = error.or(ready(scope.pop()));
        }
        if let Some(reason) = self.lost.lock().ok().and_then(|lost| lost.clone()) {
            return Err(GpuError::Lost { stage, reason });
        }
        match error {
            None => done,
            Some(wgpu::Error::OutOfMemory { .. }) => Err(GpuError::OutOfMemory { stage }),
            Some(other) => Err(GpuError::Failed { stage, reason: one_line(&other.to_string()) }),
        }
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The value of a future that needs no executor: those of native devices are finished when they are made.
pub(crate) fn ready<F: Future>(future: F) -> F::Output {
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(value) = future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return value;
        }
        std::thread::yield_now();
    }
}
