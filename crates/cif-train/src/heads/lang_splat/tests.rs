use super::*;
use crate::heads::testing::{check_gradients, features, field, loss, tensors};

#[test]
fn gradients_are_those_of_double_precision() {
    let field = field(40);
    let features = features(&field).pixels;
    assert!(features.contains(&[0.0; CODE]), "some pixels have no feature");
    let mut tensors = tensors(&LangSplat, &field);
    assert!(tensors.values(&CODES).iter().all(|code| *code == 0.0), "codes start from 0");
    // Away from the kink of absolute values.
    for (row, code) in tensors.values_mut(&CODES).iter_mut().enumerate() {
        *code = ((row * 11) % 17) as f32 / 8.0 - 1.03;
    }
    let value = loss(&LangSplat, &mut tensors, &field);
    let oracle = |values: &[Vec<f64>]| {
        let mut sum = 0.0;
        for (code, feature) in values[0].chunks_exact(CODE).zip(&features) {
            let has_feature = *feature != [0.0; CODE];
            let differences =
                code.iter().zip(feature).map(|(code, feature)| (code - f64::from(*feature)).abs());
            sum += if has_feature { differences.sum() } else { 0.0 };
        }
        0.2 * sum / values[0].len() as f64
    };
    let start: Vec<f64> = tensors.values(&CODES).iter().map(|v| f64::from(*v)).collect();
    assert!((value / oracle(&[start]) - 1.0).abs() < 1e-5);
    check_gradients(&LangSplat, &mut tensors, 1, &oracle);
}

#[test]
fn frames_without_a_map_teach_nothing() {
    let field = field(4);
    let mut tensors = tensors(&LangSplat, &field);
    let blended = cif_render::BlendedImage { width: 4, height: 1, channels: CODE, values: vec![0.5; 12] };
    let labels = cif_geometry::PixelGrid::filled(4, 1, 1);
    let view = HeadView { blended: &blended, labels: &labels, features: None, seed: 0 };
    let mut v_blended = vec![0.0; 12];
    assert_eq!(LangSplat.loss(&mut tensors, &view, 1.0, &mut v_blended), HeadLoss::default());
    assert!(v_blended.iter().all(|v| *v == 0.0));
}
