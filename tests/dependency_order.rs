//! The order of the crates: formats <- runtime <- bake <- the program, and nothing against it.

use serde_json::{Value, json};
use std::process::Command;

/// The crates of the workspace; each may depend on those before it.
const ORDER: [&str; 4] = ["smoke-formats", "smoke-runtime", "smoke-baking", "smoke-bake"];

fn metadata() -> Value {
    let cargo = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--offline"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(cargo.status.success(), "{}", String::from_utf8_lossy(&cargo.stderr));
    serde_json::from_slice(&cargo.stdout).unwrap()
}

/// Crates that are not in the order, and edges between crates of the workspace that go against it.
fn violations(metadata: &Value) -> Vec<String> {
    let place = |name: &str| ORDER.iter().position(|n| *n == name);
    let mut found = Vec::new();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        let Some(at) = place(name) else {
            found.push(format!("{name} has no place in the order"));
            continue;
        };
        for dependency in package["dependencies"].as_array().unwrap() {
            // Kinds of every sort count: a dev-dependency against the arrow is a cycle as well.
            let on = dependency["name"].as_str().unwrap();
            if place(on).is_some_and(|other| other >= at) {
                found.push(format!("{name} -> {on}"));
            }
        }
    }
    found
}

#[test]
fn crates_depend_only_on_those_before_them() {
    let metadata = metadata();
    assert_eq!(metadata["packages"].as_array().unwrap().len(), ORDER.len());
    assert_eq!(violations(&metadata), [""; 0]);
}

#[test]
fn the_check_sees_a_planted_edge_against_the_order_and_a_crate_without_a_place() {
    let mut metadata = metadata();
    let packages = metadata["packages"].as_array_mut().unwrap();
    let formats = packages.iter_mut().find(|p| p["name"] == "smoke-formats").unwrap();
    formats["dependencies"].as_array_mut().unwrap().push(json!({ "name": "smoke-runtime" }));
    packages.push(json!({ "name": "smoke-extra", "dependencies": [] }));
    assert_eq!(violations(&metadata), ["smoke-formats -> smoke-runtime", "smoke-extra has no place in the order"]);
}
