// Harmonics of the bands below `bands`, by the recurrences of harmonics.rs.
fn harmonics(bands: u32, d: vec3<f32>) -> array<f32, 36> {
    var out: array<f32, 36>;
    var real = 1.0;
    var imaginary = 0.0;
    var diagonal = 1.0;
    for (var m = 0u; m < bands; m++) {
        var before = 0.0;
        var current = diagonal;
        // (l-m)! / (l+m)! at l = m, then from band to band.
        var factor = 1.0;
        for (var k = 2u; k <= 2u * m; k++) { factor /= f32(k); }
        for (var l = m; l < bands; l++) {
            let twice = select(1.0, 2.0, m > 0u);
            let norm = sqrt(f32(2u * l + 1u) * 0.07957747 * twice * factor);
            out[l * (l + 1u) + m] = norm * current * real;
            if m > 0u { out[l * (l + 1u) - m] = norm * current * imaginary; }
            let next = (f32(2u * l + 1u) * d.z * current - f32(l + m) * before) / f32(l + 1u - m);
            before = current;
            current = next;
            factor *= f32(l + 1u - m) / f32(l + 1u + m);
        }
        let next_real = real * d.x - imaginary * d.y;
        imaginary = real * d.y + imaginary * d.x;
        real = next_real;
        diagonal *= -f32(2u * m + 1u);
    }
    return out;
}
