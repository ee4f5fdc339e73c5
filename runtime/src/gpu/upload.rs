//! A frame on the device before it is drawn: density, bricks and transfer, which are the same under any light and for
//! any eye.
//!
//! It is made on any thread, also while another frame is drawn, and only read from then on, so that renderers share it.
//! The copies are submitted when it is made, and a later submission finds them done. What drawing writes (nodes of the
//! bricks, light of the transfer) belongs to the renderer: of a frame that waits for its turn the device holds four
//! bytes a node, and its transfer.
//!
//! Error scopes of a device belong to the thread that opens them, so what fails here is an error here, never in the
//! picture that another thread is drawing.

use super::device::Gpu;
use super::renderer::GpuRenderError;
use super::transfer_rows::DeviceRows;
use super::volume::DeviceBricks;
use crate::medium::frame::Frame;
use std::sync::Arc;

/// See the module's head.
pub struct UploadedFrame {
    /// The frame in memory.
    pub frame: Arc<Frame>,
    /// `array<f32>`: its density, one value a node, x fastest.
    pub(super) density: wgpu::Buffer,
    pub(super) bricks: Arc<DeviceBricks>,
    /// Its transfer, if it has one.
    pub(super) rows: Option<Arc<DeviceRows>>,
}

impl UploadedFrame {
    /// A copy of `frame` on the device; refused if that cannot hold it, or if its transfer is none of its density.
    pub fn new(gpu: &Gpu, frame: impl Into<Arc<Frame>>) -> Result<Self, GpuRenderError> {
        let frame = frame.into();
        let density = gpu.checked("upload", || gpu.upload("density of the frame", &frame.field.values))?;
        let bricks = Arc::new(DeviceBricks::of_field(gpu, &frame.field)?);
        let rows = frame.transfer.as_ref().map(|transfer| DeviceRows::new(gpu, &frame.field, transfer)).transpose()?;
        // Nothing but the copies that wait: they begin now, not with the first pass that reads them.
        gpu.checked("upload", || {
            gpu.queue.submit([]);
            Ok(())
        })?;
        Ok(Self { frame, density, bricks, rows: rows.map(Arc::new) })
    }

    /// Bytes on the device.
    pub fn bytes(&self) -> u64 {
        let own = [&self.density, &self.bricks.places, &self.bricks.dense_bricks].map(wgpu::Buffer::size);
        own.iter().sum::<u64>() + self.rows.as_ref().map_or(0, |rows| rows.bytes())
    }
}
