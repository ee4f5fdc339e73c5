//! The demo from an empty folder: what it leaves behind is whole, bright and different from picture to picture.

mod common;

use smoke_formats::image;

#[test]
fn the_demo_leaves_a_good_pack_finite_frames_and_a_sheet() {
    let folder = tempfile::tempdir().unwrap();
    let report = common::answer(folder.path(), &["demo", "out", "--progress", "none"]);
    assert!(report.contains("contact_sheet.png"), "{report}");
    let out = folder.path().join("out");
    assert!(common::answer(&out, &["validate", "plume.smoke"]).starts_with("ok: 8 frames"));

    let relit = ["turned", "thin", "sun", "thick"].map(str::to_owned);
    let names = (1..=8).map(|n| format!("plume.{n:04}")).chain(relit);
    let frames: Vec<Vec<[f32; 3]>> = names
        .map(|name| {
            let path = out.join("frames").join(name + ".exr");
            let frame = image::read(&path).unwrap().rgb(&path).unwrap();
            assert_eq!((frame.width, frame.height), (300, 400), "{}", path.display());
            frame.pixels
        })
        .collect();
    for (i, frame) in frames.iter().enumerate() {
        assert!(frame.iter().flatten().all(|v| v.is_finite() && *v >= 0.0), "frame {i}");
        // Far above the rounding of half floats: another time, another light or another medium is another picture.
        for (j, other) in frames.iter().enumerate().skip(i + 1) {
            let pairs = frame.iter().flatten().zip(other.iter().flatten());
            let (mut difference, mut sum) = (0.0, 0.0);
            for (a, b) in pairs {
                difference += f64::from((a - b).abs());
                sum += f64::from(a + b);
            }
            assert!(difference > 0.005 * sum, "pictures {i} and {j}: {difference} of {sum}");
        }
    }
    // The signature of PNG, and the width in its header: four thumbnails of 300 and three lines of 2.
    let sheet = std::fs::read(out.join("contact_sheet.png")).unwrap();
    assert_eq!((&sheet[1..4], &sheet[16..20]), (&b"PNG"[..], &1206u32.to_be_bytes()[..]));
}

#[test]
fn a_folder_that_cannot_be_made_is_a_failure_in_one_line() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("taken"), "a file").unwrap();
    let message = common::refusal(folder.path(), &["demo", "taken"]);
    assert!(message.contains("taken"), "{message}");
}
