//! Our own export comes back as it was.

use cif_scene::{Motion, SceneGraph};
use proptest::prelude::*;

use super::scenes::Maker;
use super::session;
use crate::{ExportOptions, Payloads, export, read_scene};

/// Cameras to the precision of USD's lenses, everything else exactly.
fn assert_same(read: &SceneGraph, written: &SceneGraph) {
    assert_eq!(read.cameras.len(), written.cameras.len());
    for (a, b) in read.cameras.iter().zip(&written.cameras) {
        assert_eq!((&a.name, &a.label, a.samples.len()), (&b.name, &b.label, b.samples.len()));
        for (a, b) in a.samples.iter().zip(&b.samples) {
            assert_eq!(a.time_code, b.time_code);
            let (a, b) = (&a.camera, &b.camera);
            assert_eq!((a.width, a.height), (b.width, b.height));
            assert!((a.focal_px - b.focal_px).length() < 1e-4, "{a:?} {b:?}");
            assert!((a.principal_px - b.principal_px).length() < 1e-4, "{a:?} {b:?}");
            let difference = a.camera_from_world.compose(&b.camera_from_world.inverse());
            assert!(difference.translation.length() < 1e-6, "{difference:?}");
            let turn = difference.rotation - glam::DMat3::IDENTITY;
            assert!(turn.to_cols_array().iter().all(|value| value.abs() < 1e-6), "{difference:?}");
        }
    }
    for (a, b) in read.nodes.iter().zip(&written.nodes) {
        assert_eq!(a.motion, b.motion, "{}", b.name);
        assert_eq!(a, b, "{}", b.name);
    }
    let read = SceneGraph { cameras: written.cameras.clone(), ..read.clone() };
    assert_eq!(&read, written);
}

fn round_trip(written: &SceneGraph, name: &str, options: ExportOptions) -> SceneGraph {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    export(written, &path, options).unwrap();
    read_scene(&path).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn scenes_come_back_exactly(seed: u64, kind in 0..6_usize, levels_of_detail: bool) {
        let _session = session();
        let written = Maker::new(seed).scene();
        let (name, payloads) = [
            ("a.usda", Payloads::ByKind),
            ("a.usda", Payloads::SingleFile),
            ("a.usdc", Payloads::ByKind),
            ("a.usdc", Payloads::Separate),
            ("a.usdz", Payloads::ByKind),
            ("b.c.usda", Payloads::ByKind),
        ][kind];
        let options = ExportOptions { payloads, levels_of_detail, ..ExportOptions::default() };
        assert_same(&round_trip(&written, name, options), &written);
    }
}

#[test]
fn what_was_read_is_written_the_same() {
    let _session = session();
    let written = Maker::new(7).scene();
    let read = round_trip(&written, "a.usdc", ExportOptions::default());
    let again = round_trip(&read, "a.usda", ExportOptions::default());
    assert_same(&again, &read);
}

#[test]
fn selected_variants_are_what_is_read() {
    let _session = session();
    let written = Maker::new(11).scene();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.usda");
    export(&written, &path, ExportOptions::default()).unwrap();
    super::python(
        &path,
        "
from pxr import Usd
stage = Usd.Stage.Open(path)
for name, lod, physics in [('red_mug_001', 'half', 'none'), ('red_mug_006', 'quarter', 'dynamic'),
                           ('red_mug_011', 'half', 'dynamic')]:
    sets = stage.GetPrimAtPath('/World/' + name).GetVariantSets()
    assert sets.GetVariantSet('lod').GetVariantNames() == ['full', 'half', 'quarter'], name
    assert sorted(sets.GetVariantSet('physics').GetVariantNames()) == ['dynamic', 'kinematic', 'none'], name
    assert sets.GetVariantSelection('lod') == 'full'
    sets.SetSelection('lod', lod)
    sets.SetSelection('physics', physics)
stage.Save()
",
    );
    let read = read_scene(&path).unwrap();
    let counts = |graph: &SceneGraph| graph.nodes.iter().map(|node| node.splats.len()).collect::<Vec<_>>();
    let full = counts(&written);
    let read_counts = counts(&read);
    assert_eq!(read_counts[0], full[0].div_ceil(2));
    assert_eq!(read_counts[1], full[1].div_ceil(4));
    assert_eq!(read_counts[3..], full[3..]);
    assert_eq!(read.nodes[1].splats.sh_degree, 0);
    // Rows lead home from any level of detail.
    for (read, written) in read.nodes.iter().zip(&written.nodes) {
        for (index, row) in read.splats.rows.iter().enumerate() {
            let at = written.splats.rows.iter().position(|other| other == row).unwrap();
            assert_eq!(read.splats.means[index], written.splats.means[at]);
            assert_eq!(
                read.splats.sh_coefficients[index * read.splats.sh_coefficients.len() / read.splats.len()],
                written.splats.sh_coefficients
                    [at * written.splats.sh_coefficients.len() / written.splats.len()]
            );
        }
    }
    assert_eq!(read.nodes[0].motion, written.nodes[0].motion);
    // A dynamic body starts where the recording does.
    let start = &written.nodes[1].track()[0];
    let Motion::Rigid(track) = &read.nodes[1].motion else { panic!("{:?}", read.nodes[1].motion) };
    assert_eq!(
        (track.len(), track[0].translation, track[0].rotation),
        (1, start.translation, start.rotation)
    );
}
