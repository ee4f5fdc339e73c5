use glam::*;
use smoke_runtime::{
    camera::Camera,
    light::*,
    march::*,
    medium::field::DensityField,
    transport::{compensated::grid::*, medium::*, *},
};
use std::time::Instant;
fn raw(p: &str) -> Vec<f32> {
    std::fs::read(p).unwrap().chunks_exact(4).map(|c| f32::from_le_bytes([c[0], c[1], c[2], c[3]])).collect()
}
fn main() {
    let mut args = pico(std::env::args().skip(1).collect());
    let f = args("f", "1040");
    let num = |s: String| s.parse::<f64>().unwrap();
    let (sig, alb, g) =
        (num(args("sigma", "8")) as f32, num(args("albedo", "0.92")) as f32, num(args("g", "0")) as f32);
    let (w, h) = (num(args("w", "320")) as usize, num(args("h", "400")) as usize);
    let order = num(args("order", "4")) as usize;
    let d0 = GridSettings::default();
    let s = GridSettings {
        beams: num(args("beams", "96")) as usize,
        single_step: num(args("s1", "0")) as usize,
        multiple_step: num(args("s2", "0")) as usize,
        rings: num(args("rings", "6")) as usize,
        multiple_order: num(args("mo", "2")) as usize,
        tolerance: num(args("tol", "2e-3")),
        ..d0
    };
    let sc = if args("o", "all") == "all" { ScatteringOrder::All } else { ScatteringOrder::Single };
    let step = num(args("step", "0.5")) as f32;
    let uniform = args("uniform", "0") == "1";
    let meta = raw(&format!("/tmp/x/{f}.meta"));
    let d = [meta[0] as usize, meta[1] as usize, meta[2] as usize];
    let dens = raw(&format!("/tmp/x/{f}.raw"));
    let field = DensityField::from_box(
        [0, 0, 0],
        d,
        &dens,
        DAffine3::from_scale_rotation_translation(
            DVec3::splat(meta[6] as f64),
            DQuat::IDENTITY,
            DVec3::new(meta[3] as f64, meta[4] as f64, meta[5] as f64),
        ),
    );
    let env = raw("/tmp/x/sunset.rgb");
    let env = Environment {
        width: 1024,
        height: 512,
        radiance: env.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
        rotation: 0.0,
        up_is_y: false,
    };
    let lights = [Light::Environment(if uniform { Environment::constant([1.0; 3]) } else { env })];
    let p = MediumParameters { sigma_t: [sig; 3], albedo: [alb; 3], g };
    let b = p.banded(order);
    let t = Instant::now();
    let src = solve(&field, &lights, &b, sc, &s);
    let t1 = t.elapsed().as_secs_f64();
    let t = Instant::now();
    let cam = Camera::look_at(DVec3::new(1.4, -4.6, 1.9), DVec3::new(1.3, 1.3, 1.6), DVec3::Z, 36.0, w, h);
    let vol = src.shade(&field, cam.position);
    let t2 = t.elapsed().as_secs_f64();
    let t = Instant::now();
    let film = march(&vol, &cam, b.sigma_t, &MarchSettings { step, cutoff: 1e-3 });
    let t3 = t.elapsed().as_secs_f64();
    println!("source {t1:.3} (it {} res {:.1e}) volume {t2:.3} view {t3:.3}", src.iterations, src.residual);
    if uniform {
        let e: Vec<f32> = film.pixels.iter().filter(|p| p.alpha() > 0.01).map(|p| p.radiance[1] / p.alpha()).collect();
        println!(
            "furnace mean {} min {} max {}",
            e.iter().sum::<f32>() / e.len() as f32,
            e.iter().fold(9f32, |a, b| a.min(*b)),
            e.iter().fold(0f32, |a, b| a.max(*b))
        );
    }
    let out: Vec<u8> = film
        .pixels
        .iter()
        .flat_map(|p| [p.radiance[0], p.radiance[1], p.radiance[2], p.alpha()])
        .flat_map(f32::to_le_bytes)
        .collect();
    std::fs::write("/tmp/x/out.raw", out).unwrap();
}
fn pico(v: Vec<String>) -> impl FnMut(&str, &str) -> String {
    move |k, d| v.iter().find_map(|a| a.strip_prefix(&format!("{k}="))).unwrap_or(d).to_string()
}
