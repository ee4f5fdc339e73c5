//! `smoke-bake devices`, the device that `--device` means, and frames on it.

#[cfg(feature = "gpu")]
use crate::answer;
use crate::cli::DevicesArgs;
use crate::failure::Failure;
#[cfg(feature = "gpu")]
use smoke_runtime::gpu::device::{Choice, ForcedLimits, Gpu, adapters};
#[cfg(feature = "gpu")]
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::medium::frame::Frame;
use std::sync::Arc;

/// What marches.
#[derive(Clone)]
pub enum Device {
    /// The processor.
    Cpu,
    /// An open graphics device.
    #[cfg(feature = "gpu")]
    Gpu(Arc<Gpu>),
}

/// A frame where its device draws it from.
#[derive(Clone)]
pub enum DeviceFrame {
    /// In memory, for the processor.
    Cpu(Arc<Frame>),
    /// On a graphics device, and in memory.
    #[cfg(feature = "gpu")]
    Gpu(Arc<UploadedFrame>),
}

impl DeviceFrame {
    /// The frame in memory.
    pub fn frame(&self) -> &Arc<Frame> {
        match self {
            Self::Cpu(frame) => frame,
            #[cfg(feature = "gpu")]
            Self::Gpu(uploaded) => &uploaded.frame,
        }
    }

    /// Bytes on a graphics device.
    #[cfg_attr(not(feature = "view"), expect(dead_code, reason = "only the window keeps frames"))]
    pub fn device_bytes(&self) -> u64 {
        match self {
            Self::Cpu(_) => 0,
            #[cfg(feature = "gpu")]
            Self::Gpu(uploaded) => uploaded.bytes(),
        }
    }
}

#[cfg(not(feature = "gpu"))]
const WITHOUT: &str =
    "this program was built without graphics devices; build it with --features gpu, or use --device cpu";

impl Device {
    /// `cpu`, `gpu`, or part of an adapter's name.
    pub fn open(name: &str) -> Result<Self, Failure> {
        match name {
            "cpu" => Ok(Self::Cpu),
            other => Self::open_graphics(other),
        }
    }

    #[cfg(feature = "gpu")]
    fn open_graphics(name: &str) -> Result<Self, Failure> {
        let choice = if name == "gpu" { Choice::Best } else { Choice::Named(name.to_owned()) };
        let gpu = Gpu::open(&choice, ForcedLimits::default());
        gpu.map(|gpu| Self::Gpu(Arc::new(gpu))).map_err(|e| Failure::work(e.to_string()))
    }

    #[cfg(not(feature = "gpu"))]
    fn open_graphics(_: &str) -> Result<Self, Failure> {
        Err(Failure::work(WITHOUT))
    }

    /// True for one with memory of its own.
    pub fn is_graphics(&self) -> bool {
        !matches!(self, Self::Cpu)
    }

    /// Takes a frame to where it is drawn from: a graphics device gets a copy, on any thread. The error is a line of text.
    pub fn take(&self, frame: Arc<Frame>) -> Result<DeviceFrame, String> {
        match self {
            Self::Cpu => Ok(DeviceFrame::Cpu(frame)),
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => {
                let uploaded = UploadedFrame::new(gpu, frame).map_err(|e| e.to_string())?;
                Ok(DeviceFrame::Gpu(Arc::new(uploaded)))
            }
        }
    }

    /// As an image's metadata has it: `cpu`, or the adapter's name.
    pub fn name(&self) -> &str {
        match self {
            Self::Cpu => "cpu",
            #[cfg(feature = "gpu")]
            Self::Gpu(gpu) => &gpu.summary().name,
        }
    }
}

/// Lists them, the one that `--device gpu` means first.
#[cfg(feature = "gpu")]
pub fn run(args: &DevicesArgs) -> Result<(), Failure> {
    let adapters = adapters();
    if args.json {
        let rows = adapters.iter().map(|a| {
            serde_json::json!({
                "name": a.name, "backend": a.backend, "kind": a.kind, "driver": a.driver,
                "storage_binding_bytes": a.storage_binding, "buffer_bytes": a.buffer, "timestamps": a.timestamps,
            })
        });
        return answer::json(&rows.collect::<Vec<_>>());
    }
    let line = |a: &smoke_runtime::gpu::device::AdapterSummary| {
        let mebibytes = a.storage_binding >> 20;
        format!("{}  ({}, {}, {}; {mebibytes} MiB a binding)\n", a.name, a.kind, a.backend, a.driver)
    };
    let lines: String = adapters.iter().map(line).collect();
    answer::text(if lines.is_empty() { "no graphics device; --device cpu is what there is\n" } else { &lines })
}

/// Says that there are none in this build.
#[cfg(not(feature = "gpu"))]
pub fn run(_: &DevicesArgs) -> Result<(), Failure> {
    Err(Failure::work(WITHOUT))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_is_always_there_and_what_is_not_there_is_refused_in_one_line_that_says_what_to_do() {
        assert_eq!(Device::open("cpu").unwrap().name(), "cpu");
        let Err(Failure::Work(message)) = Device::open("no such device") else { panic!("it was opened") };
        assert!(message.contains("--device cpu") && !message.contains('\n'), "{message}");
    }
}
