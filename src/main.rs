//! smoke-bake: bakes smoke sequences into relightable packs, and renders them.
fn main() {}
