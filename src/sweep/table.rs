//! The rows of a sweep, and the same as CSV and JSON.

use super::store::Key;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

/// Wall seconds of one render, the median of all renders of a point.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Seconds {
    /// Seconds by the name of the stage, in order: `decode`, then those of the method.
    #[serde(flatten)]
    pub stages: Map<String, Value>,
    /// All of it.
    pub total: f64,
}

impl Seconds {
    /// The seconds of each stage, and their sum.
    pub fn new<'a>(stages: impl Iterator<Item = (&'a str, f64)>) -> Self {
        let mut seconds = Self::default();
        for (name, value) in stages {
            seconds.stages.insert(name.to_owned(), json!(value));
            seconds.total += value;
        }
        seconds
    }
}

/// What was measured at one point. Errors are relative to the reference, over the pixels where either image has alpha
/// above zero, the reference's noise taken out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Root of the mean squared error over that of the mean squared reference.
    pub relative_rmse: f64,
    /// Its standard error.
    pub relative_rmse_standard_error: f64,
    /// Mean error over the mean of the reference.
    pub bias: f64,
    /// Its standard error.
    pub bias_standard_error: f64,
    /// Mean FLIP, 0 to 1, the reference's noise included.
    pub flip: f64,
    /// Seconds.
    pub seconds: Seconds,
    /// Bytes of the pack's file.
    pub pack_bytes: u64,
    /// Bits of the pack's frames at rest for each active voxel.
    pub bits_per_active_voxel: f64,
    /// The method, with its route if it has several.
    pub method: String,
    /// Every setting, as `render` stores it in an image, and the threads.
    pub settings: Value,
}

/// Which scene a row is of.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    /// The scene file as it was given.
    pub scene: String,
    /// Value of each axis.
    pub axes: Vec<(String, String)>,
    /// Frame number.
    pub frame: i32,
}

/// One row.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// Its scene and frame.
    pub place: Place,
    /// The dial that was turned.
    pub dial: String,
    /// Its value.
    pub value: String,
    /// Bake options of its pack that are not at their default, as text; empty for the input itself.
    pub bake: String,
    /// What was measured.
    pub figures: Figures,
    /// Its thumbnails.
    pub picture: Key,
}

/// A point of the path tracer's own curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progressed {
    /// Passes made.
    pub passes: u32,
    /// Seconds since the first began.
    pub seconds: f64,
    /// Relative standard error over the pixels seen.
    pub relative_standard_error: f64,
}

/// What is known of one reference.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReferenceFigures {
    /// Passes made.
    pub passes: u32,
    /// Seconds of all of them.
    pub seconds: f64,
    /// Relative standard error over the pixels seen.
    pub relative_standard_error: f64,
    /// After each power of two of passes, and the last.
    pub curve: Vec<Progressed>,
}

/// One reference and the rows that are measured against it.
#[derive(Clone, Debug, PartialEq)]
pub struct Group {
    /// Its scene and frame.
    pub place: Place,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// The reference.
    pub reference: ReferenceFigures,
    /// Its picture.
    pub picture: Key,
    /// Error at which false colours are full, relative to the root mean square of the reference over the pixels seen.
    pub full_colour: f64,
    /// The rows, in the order of the points.
    pub rows: Vec<Row>,
    /// Points that could not be rendered: dial, value, why.
    pub refused: Vec<[String; 3]>,
}

/// All rows as CSV (RFC 4180, but lines end in LF), a line of names first. Axes are the second and following columns.
pub fn csv(groups: &[Group]) -> String {
    let rows = || groups.iter().flat_map(|g| &g.rows);
    let axes = groups.first().map_or(&[][..], |g| &g.place.axes).iter().map(|(name, _)| name.clone());
    let mut stages: Vec<&String> = Vec::new();
    for name in rows().flat_map(|row| row.figures.seconds.stages.keys()) {
        if !stages.contains(&name) {
            stages.push(name);
        }
    }
    let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    let mut head = names(&["scene"]);
    head.extend(axes);
    head.extend(names(&["frame", "method", "dial", "value"]));
    head.extend(names(&["relative_rmse", "relative_rmse_standard_error", "bias", "bias_standard_error", "flip"]));
    head.extend(stages.iter().map(|stage| format!("{stage}_seconds")));
    head.extend(names(&["total_seconds", "pack_bytes", "bits_per_active_voxel", "bake", "settings"]));
    let mut out = record(head);
    for row in rows() {
        let (place, f) = (&row.place, &row.figures);
        let mut fields = vec![place.scene.clone()];
        fields.extend(place.axes.iter().map(|(_, value)| value.clone()));
        fields.extend([place.frame.to_string(), f.method.clone(), row.dial.clone(), row.value.clone()]);
        let errors = [f.relative_rmse, f.relative_rmse_standard_error, f.bias, f.bias_standard_error, f.flip];
        fields.extend(errors.map(|v| v.to_string()));
        // A stage that this method does not have is empty, not zero.
        fields.extend(stages.iter().map(|&stage| f.seconds.stages.get(stage).map_or(String::new(), Value::to_string)));
        fields.extend([f.seconds.total.to_string(), f.pack_bytes.to_string(), f.bits_per_active_voxel.to_string()]);
        fields.extend([row.bake.clone(), f.settings.to_string()]);
        out += &record(fields);
    }
    out
}

/// One line of CSV.
fn record(fields: Vec<String>) -> String {
    let field = |text: String| match text.contains(['"', ',', '\n', '\r']) {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text,
    };
    fields.into_iter().map(field).collect::<Vec<_>>().join(",") + "\n"
}

/// All of a sweep as one document; `sweep` is what was asked for.
pub fn json(groups: &[Group], sweep: Value) -> Value {
    let place = |place: &Place| {
        let axes: Map<String, Value> = place.axes.iter().map(|(name, value)| (name.clone(), json!(value))).collect();
        json!({ "scene": place.scene, "axes": axes, "frame": place.frame })
    };
    let with = |mut document: Value, more: Value| {
        if let (Value::Object(document), Value::Object(more)) = (&mut document, more) {
            document.extend(more);
        }
        document
    };
    let reference = |group: &Group| {
        let size = json!({ "width": group.size[0], "height": group.size[1] });
        let figures = serde_json::to_value(&group.reference).unwrap_or_default();
        with(with(place(&group.place), size), figures)
    };
    let row = |row: &Row| {
        let turned = json!({ "dial": row.dial, "value": row.value, "bake": row.bake });
        let figures = serde_json::to_value(&row.figures).unwrap_or_default();
        with(with(place(&row.place), turned), figures)
    };
    let refused = |group: &Group| -> Vec<Value> {
        let one = |[dial, value, why]: &[String; 3]| {
            with(place(&group.place), json!({ "dial": dial, "value": value, "reason": why }))
        };
        group.refused.iter().map(one).collect()
    };
    json!({
        "program": concat!("smoke-bake ", env!("CARGO_PKG_VERSION")),
        "sweep": sweep,
        "references": groups.iter().map(reference).collect::<Vec<_>>(),
        "rows": groups.iter().flat_map(|g| &g.rows).map(row).collect::<Vec<_>>(),
        "refused": groups.iter().flat_map(refused).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// A group with the given rows: dial, value, method, error, seconds.
    pub fn group(rows: &[(&str, &str, &str, f64, f64)]) -> Group {
        let axes = vec![("sigma-t".into(), "8".into()), ("g".into(), "-0.5".into())];
        let place = Place { scene: "a \"b\", <c>.toml".into(), axes, frame: 7 };
        let row = |&(dial, value, method, error, total): &(&str, &str, &str, f64, f64)| Row {
            place: place.clone(),
            dial: dial.into(),
            value: value.into(),
            bake: String::new(),
            figures: Figures {
                relative_rmse: error,
                relative_rmse_standard_error: 0.001,
                bias: -0.5 * error,
                bias_standard_error: 0.0005,
                flip: 0.03,
                seconds: Seconds::new([("decode", 0.25 * total), ("view_pass", 0.75 * total)].into_iter()),
                pack_bytes: 1000,
                bits_per_active_voxel: 4.5,
                method: method.into(),
                settings: json!({ "render": { "sh_order": 4 }, "threads": 2 }),
            },
            picture: Key::of(&[dial, value]),
        };
        let point = |passes, seconds, relative_standard_error| Progressed { passes, seconds, relative_standard_error };
        Group {
            place: place.clone(),
            size: [12, 8],
            reference: ReferenceFigures {
                passes: 24,
                seconds: 3.0,
                relative_standard_error: 0.006,
                curve: vec![point(16, 2.0, 0.008), point(24, 3.0, 0.006)],
            },
            picture: Key::of(&["reference"]),
            full_colour: 0.1,
            rows: rows.iter().map(row).collect(),
            refused: vec![["gaussians".into(), "0".into(), "no <Gaussians>".into()]],
        }
    }

    /// The fields of one line of CSV, by the rules of RFC 4180.
    fn fields(line: &str) -> Vec<String> {
        let (mut fields, mut quoted) = (vec![String::new()], false);
        let mut characters = line.chars().peekable();
        while let Some(c) = characters.next() {
            match (c, quoted) {
                ('"', true) if characters.peek() == Some(&'"') => {
                    characters.next();
                    fields.last_mut().unwrap().push('"');
                }
                ('"', _) => quoted = !quoted,
                (',', false) => fields.push(String::new()),
                (c, _) => fields.last_mut().unwrap().push(c),
            }
        }
        assert!(!quoted);
        fields
    }

    #[test]
    fn csv_has_the_axes_as_columns_and_keeps_commas_quotes_and_every_digit() {
        let error = 0.1 + 0.2;
        let text = csv(&[group(&[("defaults", "", "grid", error, 0.25), ("sh-order", "1", "grid", 0.0, 1e-9)])]);
        let lines: Vec<_> = text.lines().map(fields).collect();
        assert_eq!(lines.len(), 3);
        assert!(lines.iter().all(|l| l.len() == lines[0].len()));
        assert_eq!(lines[0][..6], ["scene", "sigma-t", "g", "frame", "method", "dial"]);
        let at = |name: &str| lines[0].iter().position(|n| n == name).unwrap();
        assert_eq!(lines[1][..6], ["a \"b\", <c>.toml", "8", "-0.5", "7", "grid", "defaults"]);
        assert_eq!(lines[1][at("relative_rmse")].parse::<f64>().unwrap(), error);
        assert_eq!(lines[2][at("total_seconds")].parse::<f64>().unwrap(), 1e-9);
        let settings: Value = serde_json::from_str(&lines[1][at("settings")]).unwrap();
        assert_eq!(settings["render"]["sh_order"], 4);
        assert_eq!(csv(&[]).lines().count(), 1);
    }

    #[test]
    fn the_document_holds_references_rows_and_what_was_refused() {
        let document = json(&[group(&[("cutoff", "0.1", "grid", 0.02, 0.25)])], json!({ "input": "a" }));
        let row = &document["rows"][0];
        assert_eq!((row["dial"].as_str(), row["axes"]["g"].as_str()), (Some("cutoff"), Some("-0.5")));
        assert_eq!((row["relative_rmse"].as_f64(), row["seconds"]["total"].as_f64()), (Some(0.02), Some(0.25)));
        assert_eq!(document["references"][0]["curve"][1]["passes"], 24);
        assert_eq!((&document["refused"][0]["dial"], &document["sweep"]["input"]), (&json!("gaussians"), &json!("a")));
    }
}
