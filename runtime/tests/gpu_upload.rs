//! Frames that are uploaded while others are drawn: the same bits as in turn, and errors where they belong. `gpu_common`
//! says where.
#![cfg(feature = "gpu")]

mod gpu_common;

use gpu_common::{cameras, device, plume, radiance, sky, tiny, told};
use smoke_formats::gaussian::UnitSpace;
use smoke_runtime::camera::Camera;
use smoke_runtime::gpu::device::{ForcedLimits, Gpu, GpuError};
use smoke_runtime::gpu::renderer::{GpuRenderError, GpuRenderer, SolveOn};
use smoke_runtime::gpu::upload::UploadedFrame;
use smoke_runtime::medium::field::DensityField;
use smoke_runtime::medium::frame::Frame;
use smoke_runtime::renderer::{RenderSettings, Route};
use smoke_runtime::transport::compensated::grid::route::GridSettings;
use smoke_runtime::transport::medium::MediumParameters;
use std::sync::Arc;
use std::thread::scope;

fn frame(field: DensityField) -> Frame {
    let (unit, world_from_index) = (UnitSpace::of_box([0; 3], [8; 3]), field.world_from_node);
    Frame { field, gaussians: vec![], unit, first_node: [0; 3], world_from_index, transfer: None }
}

/// A renderer that is quick on a software device.
fn renderer(gpu: &Arc<Gpu>) -> GpuRenderer {
    let grid = GridSettings { beams: 2, rings: 1, single_step: 2, multiple_step: 4, ..GridSettings::default() };
    let settings = RenderSettings { route: Route::Grid(grid), ..RenderSettings::default() };
    let medium = MediumParameters { sigma_t: [6.0, 8.0, 9.0], albedo: [0.95, 0.9, 0.8], g: 0.4 };
    GpuRenderer::new(Arc::clone(gpu), settings, medium, sky(), SolveOn::Processor).unwrap()
}

fn image(renderer: &mut GpuRenderer, camera: &Camera) -> Vec<f32> {
    radiance(&renderer.render(camera).unwrap().0)
}

#[test]
fn frames_that_are_uploaded_while_others_are_drawn_have_the_bits_of_frames_in_turn() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let fields = [plume(4), plume(6), tiny(), plume(5)];
    let eyes = |field: &DensityField| [0, 2].map(|at| cameras(field)[at]);
    let in_turn: Vec<_> = fields
        .iter()
        .map(|field| {
            let mut renderer = renderer(&gpu);
            renderer.set_frame(UploadedFrame::new(&gpu, frame(field.clone())).unwrap()).unwrap();
            eyes(field).map(|eye| image(&mut renderer, &eye))
        })
        .collect();
    let mut renderer = renderer(&gpu);
    let mut next = Some(UploadedFrame::new(&gpu, frame(fields[0].clone())).unwrap());
    for (turn, field) in fields.iter().enumerate() {
        renderer.set_frame(next.take().unwrap()).unwrap();
        next = scope(|scope| {
            let after = fields.get(turn + 1).map(|field| {
                let (gpu, field) = (&gpu, field.clone());
                scope.spawn(move || UploadedFrame::new(gpu, frame(field)).unwrap())
            });
            let mut drawn = 0;
            // Until the upload has ended beside it.
            while drawn == 0 || after.as_ref().is_some_and(|after| !after.is_finished()) {
                for (eye, expected) in eyes(field).iter().zip(&in_turn[turn]) {
                    assert!(image(&mut renderer, eye) == *expected, "frame {turn}, image {drawn}");
                    drawn += 1;
                }
            }
            after.map(|after| after.join().unwrap())
        });
    }
    for (turn, images) in in_turn.iter().enumerate() {
        assert!(in_turn[..turn].iter().all(|other| other[0] != images[0]), "frame {turn} is none of those before");
    }
    told(fields.len());
}

#[test]
fn renderers_that_share_a_frame_draw_what_each_draws_alone() {
    let Some(gpu) = device(ForcedLimits::default()) else { return };
    let field = plume(6);
    let uploaded = Arc::new(UploadedFrame::new(&gpu, frame(field.clone())).unwrap());
    assert!(uploaded.bytes() >= 4 * field.values.len() as u64);
    let draw = |light: usize| {
        let mut renderer = renderer(&gpu);
        renderer.set_lights(vec![sky().remove(light)]).unwrap();
        renderer.set_frame(Arc::clone(&uploaded)).unwrap();
        (0..4).map(|eye| image(&mut renderer, &cameras(&field)[eye])).collect::<Vec<_>>()
    };
    let alone = [0, 1].map(draw);
    assert!(alone[0][0] != alone[1][0]);
    let together = scope(|scope| [0, 1].map(|light| scope.spawn(move || draw(light))).map(|one| one.join().unwrap()));
    assert!(together == alone);
    told(alone.len());
}

#[test]
fn what_fails_on_the_thread_that_uploads_is_told_there_and_the_picture_goes_on() {
    let Some(gpu) = device(ForcedLimits { storage_binding: Some(64 << 10) }) else { return };
    let mut renderer = renderer(&gpu);
    renderer.set_frame(UploadedFrame::new(&gpu, frame(tiny())).unwrap()).unwrap();
    let eye = cameras(&tiny())[0];
    let expected = image(&mut renderer, &eye);
    // Too large for the device by its own word, and by the driver's, which the scopes of that thread catch.
    let large = || UploadedFrame::new(&gpu, frame(plume(1))).map(|_| ()).unwrap_err();
    let refused = || {
        gpu.checked("planted", || {
            let size = (gpu.summary().buffer + 1).next_multiple_of(4);
            let usage = wgpu::BufferUsages::STORAGE;
            let _ = gpu.parts().0.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage,
                mapped_at_creation: false,
            });
            Ok(())
        })
    };
    for _ in 0..3 {
        scope(|scope| {
            let uploads = scope.spawn(|| (large(), refused().unwrap_err()));
            while !uploads.is_finished() {
                assert!(image(&mut renderer, &eye) == expected);
            }
            let (large, refused) = uploads.join().unwrap();
            assert!(matches!(large, GpuRenderError::Gpu(GpuError::Limit { limit: 65536, .. })), "{large}");
            assert!(matches!(refused, GpuError::Failed { stage: "planted", .. }), "{refused}");
        });
        assert!(image(&mut renderer, &eye) == expected);
    }
    gpu.parts().0.destroy();
    let lost = scope(|scope| scope.spawn(|| UploadedFrame::new(&gpu, frame(tiny())).map(|_| ())).join().unwrap());
    let lost = lost.unwrap_err().to_string();
    assert!(lost.contains("--device cpu"), "{lost}");
    told(3);
}
