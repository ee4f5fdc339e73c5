//! What marches a frame: the processor's renderer or a graphics device's, behind the same calls.

use crate::devices::{Device, DeviceFrame};
use crate::staging::Stage;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
#[cfg(feature = "gpu")]
use smoke_runtime::gpu::renderer::{GpuRenderer, SolveOn};
use smoke_runtime::light::Light;
use smoke_runtime::renderer::{RenderSettings, Renderer, Seconds};
use smoke_runtime::transport::medium::MediumParameters;

/// Frame, lights, medium and camera in, image and seconds out; errors as a line of text. What an edit does not touch is
/// kept, see [`Renderer`].
pub trait Marcher: Send {
    /// Another frame, which the same device has taken.
    fn set_frame(&mut self, frame: DeviceFrame) -> Result<(), String>;
    /// Other lights.
    #[cfg_attr(not(feature = "view"), expect(dead_code, reason = "only the window edits"))]
    fn set_lights(&mut self, lights: Vec<Light>) -> Result<(), String>;
    /// Another medium.
    #[cfg_attr(not(feature = "view"), expect(dead_code, reason = "only the window edits"))]
    fn set_medium(&mut self, medium: MediumParameters) -> Result<(), String>;
    /// The image from `camera`.
    fn render(&mut self, camera: &Camera) -> Result<(Film, Seconds), String>;
    /// Microseconds of the graphics device's stages since the last call, where there is one and it can tell.
    fn device_microseconds(&self) -> Vec<(&'static str, f64)>;
}

/// The same calls of either renderer.
macro_rules! marches {
    ($renderer:ty, $of:ident, $times:expr) => {
        impl Marcher for $renderer {
            fn set_frame(&mut self, frame: DeviceFrame) -> Result<(), String> {
                match frame {
                    DeviceFrame::$of(frame) => Self::set_frame(self, frame).map_err(|e| e.to_string()),
                    #[cfg(feature = "gpu")]
                    _ => Err("frame: found one of another device, expected one of this".into()),
                }
            }

            fn set_lights(&mut self, lights: Vec<Light>) -> Result<(), String> {
                Self::set_lights(self, lights).map_err(|e| e.to_string())
            }

            fn set_medium(&mut self, medium: MediumParameters) -> Result<(), String> {
                Self::set_medium(self, medium).map_err(|e| e.to_string())
            }

            fn render(&mut self, camera: &Camera) -> Result<(Film, Seconds), String> {
                Self::render(self, camera).map_err(|e| e.to_string())
            }

            fn device_microseconds(&self) -> Vec<(&'static str, f64)> {
                $times(self)
            }
        }
    };
}

marches!(Renderer, Cpu, |_| Vec::new());
#[cfg(feature = "gpu")]
marches!(GpuRenderer, Gpu, |renderer: &GpuRenderer| renderer.gpu().take_times());

/// What marches on `device`, under the lights and medium of `stage`.
pub fn marcher(device: &Device, settings: RenderSettings, stage: &Stage) -> Result<Box<dyn Marcher>, String> {
    let (medium, lights) = (stage.medium, stage.lights.clone());
    Ok(match device {
        Device::Cpu => Box::new(Renderer::new(settings, medium, lights).map_err(|e| e.to_string())?),
        #[cfg(feature = "gpu")]
        Device::Gpu(gpu) => {
            let solve_on = SolveOn::best(gpu);
            Box::new(GpuRenderer::new(gpu.clone(), settings, medium, lights, solve_on).map_err(|e| e.to_string())?)
        }
    })
}
