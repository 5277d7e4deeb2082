use super::*;

fn frame(view: &str, time_index: usize, counts: &[(u16, u16, u64)]) -> FrameConfusion {
    FrameConfusion {
        view: view.to_owned(),
        time_index,
        counts: counts.iter().map(|&(truth, predicted, count)| ((truth, predicted), count)).collect(),
    }
}

fn close(value: Option<f64>, expected: f64) {
    let value = value.expect("defined");
    assert!((value - expected).abs() < 1e-9, "{value} instead of {expected}");
}

/// Two frames worked out by hand.
///
/// Frame 0: instance 1 has 80 pixels (60 right, 20 as 2), instance 2 has 20 (all right), void 100 of which
/// 10 are predicted 1. Frame 1: instance 1 has 50 (all right), instance 2 absent, 3 predicted on 10 of void.
fn two_frames() -> Vec<FrameConfusion> {
    vec![
        frame("a", 0, &[(1, 1, 60), (1, 2, 20), (2, 2, 20), (0, 1, 10), (0, 0, 90)]),
        frame("a", 1, &[(1, 1, 40), (1, 2, 10), (0, 3, 10), (0, 0, 140)]),
    ]
}

#[test]
fn primary_metrics_by_hand() {
    let metrics = instance_metrics(&two_frames());
    close(metrics.macc_pix, 100.0 * (0.8 + 0.8) / 2.0);
    // Instance 1: (60/80 + 40/50) / 2; instance 2: 1.
    close(metrics.macc_inst, 100.0 * (0.775 + 1.0) / 2.0);
    // (1, 0): 60/80, (2, 0): 20/40, (1, 1): 40/50.
    close(metrics.miou, 100.0 * (0.75 + 0.5 + 0.8) / 3.0);
}

#[test]
fn variants_by_hand() {
    let metrics = instance_metrics(&two_frames());
    close(metrics.macc_pix_pooled, 100.0 * 120.0 / 150.0);
    close(metrics.macc_inst_pooled, 100.0 * (100.0 / 130.0 + 1.0) / 2.0);
    close(metrics.miou_per_instance_first, 100.0 * (0.775 + 0.5) / 2.0);
    // Instance 2 is predicted on V of frame 1, which does not show it; instance 3 only on void.
    close(metrics.miou_with_fp, 100.0 * (0.75 + 0.5 + 0.8) / 4.0);
    close(metrics.miou_all_pixels, 100.0 * (60.0 / 90.0 + 0.5 + 0.8) / 3.0);
    // Tube 1: 100 of 130; tube 2: 20 of 20 + 50 - 20.
    close(metrics.tube_iou, 100.0 * (100.0 / 130.0 + 20.0 / 50.0) / 2.0);
    // Instance 1: 100/130 x 100/130 + 30/130 x 30/(50 + 130 - 30); instance 2: 20/20 x 20/50.
    let first = (100.0f64 / 130.0).powi(2) + 30.0 / 130.0 * (30.0 / 150.0);
    close(metrics.association_quality, 100.0 * (first + 0.4) / 2.0);
}

#[test]
fn scores_per_instance() {
    let metrics = instance_metrics(&two_frames());
    assert_eq!(
        metrics.instances.iter().map(|score| (score.id, score.frames)).collect::<Vec<_>>(),
        [(1, 2), (2, 1)]
    );
    close(metrics.instances[0].iou, 77.5);
    close(metrics.instances[1].accuracy, 100.0);
}

#[test]
fn nothing_labelled_is_undefined() {
    for frames in [vec![], vec![frame("a", 0, &[(0, 0, 50), (0, 4, 50)])]] {
        let metrics = instance_metrics(&frames);
        assert_eq!(metrics, InstanceMetrics::default());
    }
}

#[test]
fn nothing_predicted_is_zero_and_defined() {
    let metrics = instance_metrics(&[frame("a", 0, &[(1, 0, 10), (0, 0, 5)])]);
    close(metrics.macc_pix, 0.0);
    close(metrics.miou, 0.0);
    close(metrics.association_quality, 0.0);
    assert_eq!(metrics.id_switches_per_100, None);
}

#[test]
fn frames_without_labels_leave_the_means_alone() {
    let mut frames = two_frames();
    let before = instance_metrics(&frames);
    frames.push(frame("b", 0, &[(0, 1, 300)]));
    let after = instance_metrics(&frames);
    assert_eq!(before.macc_pix, after.macc_pix);
    assert_eq!(before.miou, after.miou);
    assert_eq!(before.tube_iou, after.tube_iou);
}

#[test]
fn an_instance_seen_only_in_training_is_no_instance_here() {
    // Id 7 exists in the field and is wrongly predicted, but occurs in no truth: it only lowers others.
    let metrics = instance_metrics(&[frame("a", 0, &[(1, 1, 50), (1, 7, 50)])]);
    assert_eq!(metrics.instances.len(), 1);
    close(metrics.macc_inst, 50.0);
    close(metrics.miou_with_fp, 25.0);
}

#[test]
fn switches_are_counted_within_a_view_and_in_time_order() {
    // In time order the majority of 1 goes 1, 1, 2: one switch in two pairs; view b adds no pair.
    let frames = [
        frame("a", 2, &[(1, 2, 150), (1, 1, 20)]),
        frame("b", 0, &[(1, 3, 150)]),
        frame("a", 0, &[(1, 1, 150)]),
        frame("a", 1, &[(1, 1, 120), (1, 2, 100)]),
    ];
    let metrics = instance_metrics(&frames);
    close(metrics.id_switches_per_100, 50.0);
    assert_eq!(metrics.instances[0].id_switches, 1);
}

#[test]
fn small_instances_are_not_watched_for_switches() {
    let frames = [frame("a", 0, &[(1, 1, 99)]), frame("a", 1, &[(1, 2, 500)])];
    assert_eq!(instance_metrics(&frames).id_switches_per_100, None);
}

#[test]
fn swapped_twins_lower_tubes_though_every_frame_has_both() {
    // Two twins swap ids half way: per-pixel accuracy 50, association quality shows that the tubes are mixed.
    let frames = [frame("a", 0, &[(1, 1, 200), (2, 2, 200)]), frame("a", 1, &[(1, 2, 200), (2, 1, 200)])];
    let metrics = instance_metrics(&frames);
    close(metrics.macc_pix, 50.0);
    close(metrics.id_switches_per_100, 100.0);
    close(metrics.association_quality, 100.0 * 2.0 * 0.5 * (200.0 / 600.0));
}

#[test]
fn confusion_counts_pixels() {
    let truth = PixelGrid::from_pixels(3, 2, vec![0, 1, 1, 1, 2, 0]);
    let predicted = PixelGrid::from_pixels(3, 2, vec![0, 1, 1, 2, 2, 1]);
    let confusion = FrameConfusion::new("a", 4, &truth, &predicted);
    assert_eq!(
        confusion.counts,
        frame("a", 4, &[(0, 0, 1), (1, 1, 2), (1, 2, 1), (2, 2, 1), (0, 1, 1)]).counts
    );
    assert_eq!(confusion.labelled(), (4, 3));
}
