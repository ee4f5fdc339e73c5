// The Henyey-Greenstein phase function (phase.rs) at the cosine `mu`, in 1/sr.
fn phase(g: f32, mu: f32) -> f32 {
    let least = (1.0 - abs(g)) * (1.0 - abs(g));
    let base = max((1.0 - g) * (1.0 - g) + 2.0 * g * (1.0 - mu), least);
    return (1.0 - g * g) / (12.566371 * base * sqrt(base));
}
