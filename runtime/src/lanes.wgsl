// Exponentials of lanes.rs. The rounding to a whole power is `round` here, and the power is put together from its bits.

// (2^k, expm1(f)) with e^-x = 2^k (1 + expm1(f)), for x >= 0; x is clamped to 87.
fn split_exponent(x: f32) -> vec2<f32> {
    let y = -min(x, 87.0);
    let k = round(y * 1.442695);
    let f = y - k * 0.6933594 - k * -2.1219444e-4;
    var p = f / 5040.0 + 1.0 / 720.0;
    p = p * f + 1.0 / 120.0;
    p = p * f + 1.0 / 24.0;
    p = p * f + 1.0 / 6.0;
    p = p * f + 0.5;
    return vec2(bitcast<f32>(u32(i32(k) + 127) << 23u), f + f * f * p);
}

// e^-x for x >= 0.
fn exp_neg(x: f32) -> f32 {
    let e = split_exponent(x);
    return e.x + e.x * e.y;
}

// (e^-x, 1 - e^-x) for x >= 0, both with small relative error.
fn exp_neg_and_rest(x: f32) -> vec2<f32> {
    let e = split_exponent(x);
    return vec2(e.x + e.x * e.y, (1.0 - e.x) - e.x * e.y);
}

// Share of a cell's emission that its near end has.
fn near_share(x: f32, rest: f32) -> f32 {
    // The series is for x below 0.5; further on it must not overflow.
    let t = min(x, 0.5);
    let thin = 0.5 + t * (1.0 / 12.0) - t * t * t * (1.0 / 720.0);
    let thick = 1.0 / max(rest, 0.3) - 1.0 / max(x, 0.3);
    return select(thick, thin, x < 0.5);
}
