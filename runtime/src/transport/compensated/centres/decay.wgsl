// exp(-x) and exp(x^2) erfc(x) for x >= 0 (decay.rs): the same polynomials. The nearest integer by its own function: what
// rounds by adding a large number may be simplified away here.

fn decay(value: f32) -> f32 {
    let x = -clamp(value, 0.0, 64.0);
    let n = round(x * 1.442695);
    let f = ((x - n * 0.69314575) - n * 1.4286068e-6) * 1.442695;
    var p = 0.0013264722;
    p = p * f + 0.009671513;
    p = p * f + 0.055507336;
    p = p * f + 0.24022242;
    p = p * f + 0.6931472;
    p = p * f + 1.0;
    return bitcast<f32>(bitcast<u32>(p) + (bitcast<u32>(i32(n)) << 23u));
}

fn erfcx(x: f32) -> f32 {
    let t = 1.0 / (1.0 + 0.4 * x);
    var p = 0.050262343;
    p = p * t - 0.18290228;
    p = p * t + 0.16908666;
    p = p * t - 0.005608489;
    p = p * t + 0.14143184;
    p = p * t + 0.1685419;
    p = p * t + 0.20784271;
    p = p * t + 0.2256696;
    p = p * t + 0.22567587;
    return t * p;
}
