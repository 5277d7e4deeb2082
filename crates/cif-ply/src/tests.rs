use std::io::Write;
use std::path::PathBuf;

use cif_geometry::spherical_harmonics::{basis, coefficient_count};
use cif_scene::{CaptureFrame, Motion, PoseSample, Splats, UpAxis};
use glam::{DMat3, DQuat, DVec3};

use super::*;

fn splats(count: usize, sh_degree: u8) -> Splats {
    let stride = 3 * coefficient_count(sh_degree);
    let mut splats = Splats { sh_degree, ..Splats::default() };
    for k in 0..count {
        let x = k as f32;
        splats.means.push([x, 0.5 - x, 0.25 * x]);
        let q = DQuat::from_axis_angle(DVec3::new(0.3, 1.0, -0.2).normalize(), 0.2 + f64::from(x));
        splats.orientations.push([q.w, q.x, q.y, q.z].map(|v| v as f32));
        splats.scales.push([0.1, 0.02 + 0.01 * x, 0.3]);
        splats.opacities.push(0.1 + 0.2 * (x % 4.0));
        splats.sh_coefficients.extend((0..stride).map(|m| (0.7 * (m + k) as f32).sin()));
        splats.occupancies.push(1.0);
        splats.identity_probabilities.push(1.0);
        splats.rows.push(k as u32);
    }
    splats
}

/// A scene of what a file holds, so that tests need no field.
fn scene(parts: &[Splats]) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    let mut graph = None;
    for (index, splats) in parts.iter().enumerate() {
        let path = folder.path().join(format!("thing {index}.ply"));
        std::fs::write(&path, ascii(splats, &Vec::new())).unwrap();
        let mut read = read(&path).unwrap();
        read.nodes[0].splats = splats.clone();
        match &mut graph {
            None => graph = Some(read),
            Some(graph) => graph.nodes.append(&mut read.nodes),
        }
    }
    graph.unwrap()
}

/// Rows of an ASCII file, properties in an unusual order; `without` leaves some out.
fn ascii(splats: &Splats, without: &[&str]) -> Vec<u8> {
    let count = coefficient_count(splats.sh_degree);
    let rest: Vec<String> = (0..3 * (count - 1)).map(|k| format!("f_rest_{k}")).collect();
    let fixed = ["rot_3", "rot_2", "rot_1", "rot_0", "opacity", "z", "y", "x", "confidence"];
    let more = ["scale_2", "scale_0", "scale_1", "f_dc_2", "f_dc_0", "f_dc_1"];
    let names: Vec<&str> = fixed.into_iter().chain(more).chain(rest.iter().map(String::as_str)).collect();
    let mut text = format!("ply\nformat ascii 1.0\nelement vertex {}\n", splats.len());
    for name in names.iter().filter(|name| !without.contains(name)) {
        text += &format!("property {} {name}\n", if *name == "x" { "double" } else { "float" });
    }
    text += "end_header\n";
    for k in 0..splats.len() {
        let number = |name: &str| -> f64 {
            let digit = |prefix: &str| name.strip_prefix(prefix).and_then(|d| d.parse::<usize>().ok());
            let sh = &splats.sh_coefficients[k * 3 * count..(k + 1) * 3 * count];
            let value = match name {
                "x" => splats.means[k][0],
                "y" => splats.means[k][1],
                "z" => splats.means[k][2],
                "confidence" => 7.0,
                "opacity" => (splats.opacities[k] / (1.0 - splats.opacities[k])).ln(),
                _ => match (digit("rot_"), digit("scale_"), digit("f_dc_"), digit("f_rest_")) {
                    (Some(i), ..) => 2.5 * splats.orientations[k][i],
                    (_, Some(i), ..) => splats.scales[k][i].ln(),
                    (_, _, Some(i), _) => sh[i],
                    (.., Some(i)) => sh[3 * (1 + i % (count - 1)) + i / (count - 1)],
                    _ => unreachable!(),
                },
            };
            f64::from(value)
        };
        let row: Vec<String> = names
            .iter()
            .filter(|name| !without.contains(name))
            .map(|name| number(name).to_string())
            .collect();
        text += &(row.join(" ") + "\n");
    }
    text.into_bytes()
}

fn assert_close(a: &Splats, b: &Splats) {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let close =
        |a: &[f32], b: &[f32]| a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5);
    assert!(close(a.means.as_flattened(), b.means.as_flattened()), "{:?} {:?}", a.means, b.means);
    assert!(close(a.orientations.as_flattened(), b.orientations.as_flattened()));
    assert!(close(a.scales.as_flattened(), b.scales.as_flattened()), "{:?} {:?}", a.scales, b.scales);
    assert!(close(&a.opacities, &b.opacities));
    assert!(close(&a.sh_coefficients, &b.sh_coefficients));
}

#[test]
fn splats_come_back_in_every_degree() {
    let folder = tempfile::tempdir().unwrap();
    for degree in 0..=3 {
        let splats = splats(7, degree);
        let path = folder.path().join(format!("mug {degree}.ply"));
        let summary = export(&scene(std::slice::from_ref(&splats)), &path, ExportOptions::default()).unwrap();
        assert_eq!(summary.bytes, path.metadata().unwrap().len());
        let graph = read(&path).unwrap();
        assert_close(&graph.nodes[0].splats, &splats);
        assert_eq!(graph.nodes[0].label, format!("mug {degree}"));
        assert_eq!(graph.nodes[0].splats.rows, (0..7).collect::<Vec<u32>>());
    }
}

#[test]
fn text_and_any_order_of_properties_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let splats = splats(5, 2);
    std::fs::write(&path, ascii(&splats, &[])).unwrap();
    assert_close(&read(&path).unwrap().nodes[0].splats, &splats);
}

#[test]
fn other_elements_and_byte_orders_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let mut header = "ply\nformat binary_big_endian 1.0\ncomment hi\nelement camera 2\nproperty list uchar int ids\nelement vertex 1\n".to_owned();
    for name in names.into_iter().chain(["rot_0", "rot_1", "rot_2", "rot_3"]) {
        header += &format!("property float {name}\n");
    }
    header += "element face 0\nproperty list uchar int vertex_indices\nend_header\n";
    let mut bytes = header.into_bytes();
    bytes.extend([1, 0, 0, 0, 5, 0]);
    let values = [1.0_f32, 2.0, 3.0, 0.1, 0.2, 0.3, 0.0, -1.0, -2.0, -3.0, 1.0, 0.0, 0.0, 0.0];
    bytes.extend(values.into_iter().flat_map(f32::to_be_bytes));
    std::fs::write(&path, &bytes).unwrap();
    let splats = &read(&path).unwrap().nodes[0].splats;
    assert_eq!((splats.means[0], splats.opacities[0], splats.sh_degree), ([1.0, 2.0, 3.0], 0.5, 0));
    assert_eq!(splats.sh_coefficients, [0.1, 0.2, 0.3]);
    assert!((splats.scales[0][1] - (-2.0_f32).exp()).abs() < 1e-7);
}

#[test]
fn turned_objects_look_the_same_from_the_turned_side() {
    let mut graph = scene(&[splats(3, 3)]);
    let turn = DQuat::from_axis_angle(DVec3::new(1.0, -0.4, 0.2).normalize(), 1.3);
    let pose = PoseSample { time_code: 0.0, translation: DVec3::new(1.0, 2.0, 3.0), rotation: turn };
    graph.nodes[0].motion = Motion::Rigid(vec![pose]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    export(&graph, &path, ExportOptions::default()).unwrap();
    let (before, after) = (&graph.nodes[0].splats, &read(&path).unwrap().nodes[0].splats);
    for k in 0..before.len() {
        let at = |splats: &Splats| DVec3::from_array(splats.means[k].map(f64::from));
        assert!((turn * at(before) + pose.translation - at(after)).length() < 1e-5);
        let direction = DVec3::new(0.48, -0.6, 0.64);
        let color = |splats: &Splats, direction: DVec3| {
            let basis = basis(direction.to_array(), 3);
            (0..16).map(|m| basis[m] * f64::from(splats.sh_coefficients[48 * k + 3 * m])).sum::<f64>()
        };
        assert!((color(before, direction) - color(after, turn * direction)).abs() < 1e-5);
        let axes = |splats: &Splats| {
            let [w, x, y, z] = splats.orientations[k].map(f64::from);
            DMat3::from_quat(DQuat::from_xyzw(x, y, z, w))
        };
        let difference = DMat3::from_quat(turn) * axes(before) - axes(after);
        assert!(difference.to_cols_array().iter().all(|value| value.abs() < 1e-5));
    }
}

#[test]
fn objects_and_sequences_get_files_of_their_own() {
    let mut graph = scene(&[splats(3, 1), splats(2, 0)]);
    graph.time_codes.samples = vec![4.0, 5.0, 6.0];
    graph.time_codes.times = vec![0.0, 0.5, 1.0];
    let track =
        |time_code| PoseSample { time_code, translation: DVec3::X * time_code, rotation: DQuat::IDENTITY };
    graph.nodes[0].motion = Motion::Rigid(vec![track(4.0), track(6.0)]);
    graph.nodes[1].visibility = vec![
        cif_scene::VisibilitySample { time_code: 4.0, visible: true },
        cif_scene::VisibilitySample { time_code: 5.0, visible: false },
    ];
    let folder = tempfile::tempdir().unwrap();
    let names = |summary: &ExportSummary| -> Vec<String> {
        let shorten = |path: &PathBuf| path.strip_prefix(folder.path()).unwrap().display().to_string();
        summary.files.iter().map(shorten).collect()
    };
    let at = folder.path().join("split");
    let options = ExportOptions { split: true, ..ExportOptions::default() };
    let summary = export(&graph, &at, options).unwrap();
    assert_eq!(names(&summary), ["split/thing_0_001.ply", "split/thing_1_001.ply"]);
    let at = folder.path().join("frames");
    let options = ExportOptions { sequence: true, ..ExportOptions::default() };
    let summary = export(&graph, &at, options).unwrap();
    assert_eq!(names(&summary), ["frames/0004.ply", "frames/0005.ply", "frames/0006.ply"]);
    let counts: Vec<usize> =
        summary.files.iter().map(|file| read(file).unwrap().nodes[0].splats.len()).collect();
    assert_eq!(counts, [5, 3, 3], "what is hidden is left out");
    let third = read(&summary.files[1]).unwrap();
    assert!((third.nodes[0].splats.means[0][0] - 5.0).abs() < 1e-6, "between two samples");
    let both = ExportOptions { split: true, sequence: true, ..ExportOptions::default() };
    let summary = export(&graph, &folder.path().join("both"), both).unwrap();
    assert_eq!(names(&summary)[..2], ["both/thing_0_001/0004.ply", "both/thing_1_001/0004.ply"]);
    assert_eq!(summary.files.len(), 4);
}

#[test]
fn existing_files_of_others_stay() {
    let graph = scene(&[splats(3, 1)]);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    std::fs::write(&path, "ply\nformat ascii 1.0\ncomment by hand\n").unwrap();
    let error = export(&graph, &path, ExportOptions::default()).unwrap_err();
    assert!(error.to_string().contains("was not written by cif"), "{error}");
    export(&graph, &path, ExportOptions { force: true, ..ExportOptions::default() }).unwrap();
    export(&graph, &path, ExportOptions::default()).expect("ours may be replaced");
    let split = ExportOptions { split: true, ..ExportOptions::default() };
    let cases = [
        ("a.splat", ExportOptions::default(), "one file of splats ends in .ply"),
        ("no/a.ply", ExportOptions::default(), "no such folder"),
        ("b.ply", split, "several files go into a folder"),
    ];
    for (name, options, says) in cases {
        let error = export(&graph, &folder.path().join(name), options).unwrap_err();
        assert!(error.to_string().contains(says), "{error}");
    }
}

#[test]
fn damaged_files_say_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let splats = splats(40, 3);
    export(&scene(std::slice::from_ref(&splats)), &path, ExportOptions::default()).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    let claims = |count: &str| {
        let at = whole.windows(10).position(|w| w == b"end_header").unwrap();
        let head = text(&whole[..at]).replace("vertex 40", &format!("vertex {count}"));
        [head.as_bytes(), &whole[at..]].concat()
    };
    let one = |word: &str, by: &str| text(&ascii(&splats, &[])).replacen(word, by, 1).into_bytes();
    let cases: Vec<(Vec<u8>, &str)> = vec![
        (whole[..whole.len() - 9].to_vec(), "cut off"),
        (whole[..200].to_vec(), "not a readable PLY"),
        (claims("1000000000"), "claims 1000000000 elements"),
        (claims("18446744073709551615"), "a.ply"),
        (ascii(&splats, &["rot_2", "opacity"]), "have no opacity, rot_2"),
        (ascii(&splats, &["f_rest_7"]), "f_rest_*"),
        (one("end_header\n", "end_header\n1 2 three\n"), "is not a number"),
        (one("property float rot_3", "property list uchar int rot_3"), "is a list"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n".to_vec(), "point cloud"),
        (ascii(&splats, &["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]), "point cloud"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty int a\nend_header\n3\n".to_vec(), "no element `vertex`"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty uint packed_position\nend_header\n1234".to_vec(), "packed"),
        (b"\x89PNG".to_vec(), "a.ply"),
        (Vec::new(), "a.ply"),
    ];
    for (bytes, says) in cases {
        std::fs::File::create(&path).unwrap().write_all(&bytes).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains(says) && error.contains("a.ply"), "{says}: {error}");
    }
    assert!(read(folder.path()).unwrap_err().to_string().contains("it is a folder"));
}

#[test]
fn splats_without_a_rotation_or_number_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let mut splats = splats(4, 0);
    splats.orientations[1] = [0.0; 4];
    splats.means[2][1] = f32::NAN;
    std::fs::write(&path, ascii(&splats, &[])).unwrap();
    let graph = read(&path).unwrap();
    assert_eq!(graph.nodes[0].splats.rows, [0, 3]);
    assert!(graph.warnings[0].starts_with("2 splats"), "{:?}", graph.warnings);
}

#[test]
fn far_scenes_stay_precise_and_say_where_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("far.ply");
    let frame = CaptureFrame { offset: [3.1e6, -2.7e5, 0.1], scale: 1e-3 };
    let near = scene(&[splats(5, 1)]);
    for (frame, is_written) in [(frame, true), (CaptureFrame::default(), false)] {
        let graph = SceneGraph { frame, ..near.clone() };
        export(&graph, &path, ExportOptions { force: true, ..ExportOptions::default() }).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let text = String::from_utf8_lossy(&bytes);
        assert_eq!(
            text.contains("comment world offset 3100000 -270000 0.1\ncomment world scale 0.001\n"),
            is_written
        );
        let back = read(&path).unwrap();
        assert_eq!(back.frame, frame);
        assert_eq!(back.nodes[0].splats.means, near.nodes[0].splats.means, "as precise as at the origin");
    }
    let head = "ply\nformat ascii 1.0\n";
    let whole = String::from_utf8(ascii(&splats(2, 0), &[])).unwrap();
    let with = |comments: &str| {
        std::fs::write(&path, whole.replacen(head, &format!("{head}{comments}"), 1)).unwrap();
        read(&path)
    };
    for wrong in ["world offset 1 2", "world offset 1 2 x", "world scale 0", "world offset 1 2 nan"] {
        let message = with(&format!("comment cif 1\ncomment {wrong}\n")).unwrap_err().to_string();
        assert!(message.contains(wrong) && message.contains("remove it"), "{message}");
    }
    // Others may write what they like.
    assert!(with("comment made elsewhere\ncomment world offset 1 2\n").unwrap().frame.is_identity());
}

/// A binary file of splats whose properties are all doubles but for colours of a type of their own.
fn doubles(rows: &[Vec<f64>], names: &[&str]) -> Vec<u8> {
    let mut text = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", rows.len());
    for name in names {
        text += &format!("property double {name}\n");
    }
    let mut bytes = (text + "end_header\n").into_bytes();
    bytes.extend(rows.iter().flatten().flat_map(|value| value.to_le_bytes()));
    bytes
}

const PLAIN: [&str; 14] = [
    "x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "f_dc_0",
    "f_dc_1", "f_dc_2",
];

fn plain(place: [f64; 3], color: [f64; 3]) -> Vec<f64> {
    [&place[..], &[1.0, -2.0, -3.0, -4.0, 1.0, 0.0, 0.0, 0.0], &color].concat()
}

#[test]
fn surveyed_coordinates_stay_exact_there_and_back() {
    let folder = tempfile::tempdir().unwrap();
    let (path, back) = (folder.path().join("utm.ply"), folder.path().join("back.ply"));
    for middle in [DVec3::new(500_123.25, 4_649_776.0, 215.0), DVec3::new(-2.7e6, 4.29e6, 3.86e6)] {
        let places: Vec<DVec3> =
            (0..9).map(|k| middle + 0.1377 * f64::from(k) * DVec3::new(1.0, -2.0, 0.7)).collect();
        let rows: Vec<_> = places.iter().map(|place| plain(place.to_array(), [0.1; 3])).collect();
        std::fs::write(&path, doubles(&rows, &PLAIN)).unwrap();
        let graph = read(&path).unwrap();
        assert!(graph.warnings.iter().any(|warning| warning.contains("origin")), "{:?}", graph.warnings);
        export(&graph, &back, ExportOptions::default()).unwrap();
        for graph in [graph, read(&back).unwrap()] {
            for (mean, place) in graph.nodes[0].splats.means.iter().zip(&places) {
                let found = graph.frame.capture_from_dataset(DVec3::from_array(mean.map(f64::from)));
                assert!((found - place).length() < 1e-4, "{found} {place}");
            }
        }
    }
    // Near ones stay as they are.
    std::fs::write(&path, doubles(&[plain([1.5, 2.0, -700.0], [0.1; 3])], &PLAIN)).unwrap();
    let graph = read(&path).unwrap();
    assert!(graph.frame.is_identity() && graph.warnings.is_empty(), "{:?}", graph.warnings);
    assert_eq!(graph.nodes[0].splats.means, [[1.5, 2.0, -700.0]]);
}

#[test]
fn antialiased_splats_are_recognised_by_a_comment() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let whole = String::from_utf8(ascii(&splats(2, 0), &[])).unwrap();
    let head = "ply\nformat ascii 1.0\n";
    let with = |comment: &str| {
        std::fs::write(&path, whole.replacen(head, &format!("{head}comment {comment}\n"), 1)).unwrap();
        read(&path).unwrap()
    };
    assert_eq!(with("Exported from elsewhere").antialiased, None);
    assert_eq!(with("SplatRenderMode: default").antialiased, Some(false));
    assert_eq!(with("antialiased 1").antialiased, Some(true));
    let odd = with("SplatRenderMode: other");
    assert!(odd.antialiased.is_none() && odd.warnings[0].contains("'other'"), "{:?}", odd.warnings);
    let mip = with("SplatRenderMode: mip");
    assert_eq!((mip.antialiased, mip.warnings.len()), (Some(true), 0));
    let back = folder.path().join("back.ply");
    export(&mip, &back, ExportOptions::default()).unwrap();
    assert_eq!(read(&back).unwrap().antialiased, Some(true));
    assert!(
        String::from_utf8_lossy(&std::fs::read(&back).unwrap()).contains("comment SplatRenderMode: mip\n")
    );
}

#[test]
fn flat_splats_are_read_and_written_as_flat_as_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let (path, back) = (folder.path().join("flat.ply"), folder.path().join("back.ply"));
    let row = |scale: f64| {
        let mut row = plain([1.0, 2.0, 3.0], [0.1; 3]);
        row[6] = scale;
        row
    };
    std::fs::write(&path, doubles(&[row(f64::NEG_INFINITY), row(-5.0)], &PLAIN)).unwrap();
    let graph = read(&path).unwrap();
    assert_eq!((graph.nodes[0].splats.scales[0][2], graph.warnings.len()), (0.0, 0));
    export(&graph, &back, ExportOptions::default()).unwrap();
    assert_eq!(read(&back).unwrap().nodes[0].splats.scales, graph.nodes[0].splats.scales);
    // 2D Gaussian Splatting has no third scale.
    let names: Vec<&str> = PLAIN.into_iter().filter(|name| *name != "scale_2").collect();
    let mut two = row(0.0);
    two.remove(6);
    std::fs::write(&path, doubles(&[two], &names)).unwrap();
    let graph = read(&path).unwrap();
    let [a, b, c] = graph.nodes[0].splats.scales[0];
    assert!(a > 0.0 && b > 0.0 && c == 0.0);
    assert!(graph.warnings[0].contains("2D Gaussian Splatting"), "{:?}", graph.warnings);
}

#[test]
fn smoothing_filters_are_a_part_of_sizes_and_opacities() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mip.ply");
    let names: Vec<&str> = PLAIN.into_iter().chain(["filter_3D"]).collect();
    let row = |filter: f64| {
        let mut row = plain([1.0, 2.0, 3.0], [0.1; 3]);
        (row[3], row[4], row[5], row[6]) = (0.0, 0.3_f64.ln(), 0.4_f64.ln(), 1.2_f64.ln());
        row.push(filter);
        row
    };
    std::fs::write(&path, doubles(&[row(0.4), row(0.0)], &names)).unwrap();
    let graph = read(&path).unwrap();
    let splats = &graph.nodes[0].splats;
    let close =
        |found: f32, expected: f64| assert!((f64::from(found) - expected).abs() < 1e-6, "{found} {expected}");
    // The roots of 0.3^2 + 0.4^2 and so on.
    let wide = [0.5, 0.32_f64.sqrt(), 1.6_f64.sqrt()];
    splats.scales[0].iter().zip(wide).for_each(|(found, expected)| close(*found, expected));
    close(splats.opacities[0], 0.5 * 0.3 * 0.4 * 1.2 / wide.iter().product::<f64>());
    close(splats.scales[1][0], 0.3);
    close(splats.opacities[1], 0.5);
    assert!(graph.warnings[0].contains("Mip-Splatting"), "{:?}", graph.warnings);
}

#[test]
fn names_of_cloudcompare_and_the_axis_of_nerfstudio_and_brush_are_understood() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let text = String::from_utf8(ascii(&splats(3, 1), &[])).unwrap();
    std::fs::write(&path, &text).unwrap();
    let expected = read(&path).unwrap();
    assert_eq!(expected.up_axis, UpAxis::Z);
    for prefix in ["scalar_", "scal_"] {
        let renamed: Vec<String> = text
            .lines()
            .map(|line| match line.strip_prefix("property float ") {
                Some(name) if !["x", "y", "z"].contains(&name) => format!("property float {prefix}{name}"),
                _ => line.to_owned(),
            })
            .collect();
        std::fs::write(&path, renamed.join("\n")).unwrap();
        assert_eq!(read(&path).unwrap().nodes[0].splats, expected.nodes[0].splats, "{prefix}");
    }
    let head = "ply\nformat ascii 1.0\n";
    for (comment, up) in [("Vertical Axis: z", UpAxis::Z), ("Vertical axis: y", UpAxis::Y)] {
        std::fs::write(&path, text.replacen(head, &format!("{head}comment {comment}\n"), 1)).unwrap();
        let graph = read(&path).unwrap();
        assert_eq!((graph.up_axis, &graph.nodes[0].splats), (up, &expected.nodes[0].splats), "{comment}");
    }
}

#[test]
fn colours_in_place_of_coefficients_are_recognised_by_their_range() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    let names: Vec<&str> = PLAIN[..11].iter().copied().chain(["red", "green", "blue"]).collect();
    for (white, notes) in [(1.0, 0), (255.0, 1), (65_535.0, 1)] {
        let rows = [[1.0, 0.2, 0.0], [0.5, 0.5, 0.5]].map(|color| plain([0.0; 3], color.map(|v| v * white)));
        std::fs::write(&path, doubles(&rows, &names)).unwrap();
        let graph = read(&path).unwrap();
        let colors = graph.nodes[0].splats.base_colors();
        let expected = [[1.0, 0.2, 0.0], [0.5, 0.5, 0.5_f32]];
        let off = colors.as_flattened().iter().zip(expected.as_flattened()).map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 1e-5, "{colors:?}");
        assert_eq!(graph.warnings.len(), notes, "{:?}", graph.warnings);
    }
}

#[test]
fn files_for_viewers_with_another_axis_up_are_turned_and_come_back_as_captured() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("turned.ply");
    let still = scene(&[splats(6, 2)]);
    for (up_axis, turn_up, sign) in [(UpAxis::Z, UpAxis::Y, 1.0), (UpAxis::Y, UpAxis::Z, -1.0)] {
        let graph = SceneGraph { up_axis, ..still.clone() };
        let options = ExportOptions { force: true, turn_up: Some(turn_up), ..ExportOptions::default() };
        export(&graph, &path, options).unwrap();
        assert_close(&read(&path).unwrap().nodes[0].splats, &still.nodes[0].splats);
        // Without our mark it is taken as it stands: what was up along one axis is up along the other.
        let bytes = std::fs::read(&path).unwrap();
        let mark = bytes.windows(12).position(|part| part == b"comment cif ").unwrap();
        let mut others = bytes.clone();
        others[mark + 8..mark + 11].copy_from_slice(b"abc");
        std::fs::write(&path, others).unwrap();
        let as_it_stands = read(&path).unwrap();
        for ([x, y, z], turned) in still.nodes[0].splats.means.iter().zip(&as_it_stands.nodes[0].splats.means)
        {
            let expected = [*x, sign * z, -sign * y];
            assert!(
                expected.iter().zip(turned).all(|(a, b)| (a - b).abs() < 1e-5),
                "{expected:?} {turned:?}"
            );
        }
        std::fs::remove_file(&path).unwrap();
    }
}
