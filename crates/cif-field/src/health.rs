//! Numerical soundness of a field: what is broken, what is merely odd, and how broken parts are repaired.
//!
//! *Broken* is what cif refuses to load, or can neither draw nor train: values that are not finite, quaternions
//! without a direction, log-scales that the renderer clamps. *Odd* is what is drawn as asked and may still be a
//! mistake: saturated opacities, copies, centres outside the box of the deformation.
//!
//! Repairs follow one rule: what is drawn stays as it was drawn. A Gaussian that is not drawn is removed, a clamped
//! value takes the value it was clamped to. Only the deformation and the identities are shared by many Gaussians, so
//! that a broken value there is replaced by the one it starts training with, which [`Repair`] reports.

use std::collections::BTreeMap;

use cif_geometry::{Bounds, quaternion};
use glam::DVec3;
use serde::Serialize;

use crate::gaussians::{FLAT_LOG_SCALE, LOG_SCALE_RANGE};
use crate::parameters::Activation;
use crate::{Field, FieldError, Gaussians, Identities};

/// Rows named per finding.
const NAMED: usize = 5;

/// Logit beyond which a sigmoid is 0 or 1 in single precision, and its gradient gone.
const SATURATED: f32 = 17.0;

/// Longest and shortest axis of a Gaussian from which it counts as a needle or a pancake.
const MAX_ASPECT: f32 = 1e4;

/// Distance from the middle of the cameras beyond which a centre counts as far away, in extents.
const FAR: f64 = 100.0;

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Cannot be loaded, drawn or trained.
    Broken,
    /// Drawn as asked, and possibly a mistake.
    Odd,
}

/// Something found in a field.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Kind of the finding, e.g. `not finite`.
    pub check: &'static str,
    /// Severity.
    pub severity: Severity,
    /// Array it was found in.
    pub array: &'static str,
    /// Rows (Gaussians), or floats of arrays without rows.
    pub count: usize,
    /// The first of them.
    pub first: Vec<usize>,
    /// Explanation, one sentence.
    pub meaning: String,
}

/// Something that was changed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Repair {
    /// Description of the repair, one sentence.
    pub what: String,
    /// Number of values, entries or Gaussians that were repaired.
    pub count: usize,
}

/// Why a field cannot be repaired.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HealthError {
    /// A rule is broken that no repair mends.
    #[error("this cannot be repaired: {0}")]
    Structure(#[from] FieldError),
    /// Nothing would be left.
    #[error("not one of {gaussians} Gaussians can be drawn, so nothing would be left; train the scene again")]
    NothingLeft {
        /// Gaussians in the field.
        gaussians: usize,
    },
}

/// Looks at every array. `never_seen` flags Gaussians that no recorded view shows, where that is known.
///
/// # Panics
/// When `never_seen` is not one flag per Gaussian.
#[must_use]
pub fn check(field: &Field, never_seen: Option<&[bool]>) -> Vec<Finding> {
    let mut found = Findings::default();
    let g = &field.gaussians;
    if !lengths_agree(g) {
        found.structure(&g.validate());
        return found.0;
    }
    check_finite(g, &mut found);
    check_shapes(g, &mut found);
    for (parameter, values) in g.tensors().into_iter().filter(|(p, _)| p.activation == Activation::Sigmoid) {
        let saturated = (0..g.len()).filter(|row| values[*row].abs() >= SATURATED);
        let what = parameter.name.trim_end_matches("_logits");
        let meaning =
            format!("their {what} is 0 or 1 in single precision, so that training no longer changes it");
        found.rows("saturated", Severity::Odd, parameter.name, saturated, &meaning);
    }
    found.rows(
        "duplicated",
        Severity::Odd,
        "gaussians",
        duplicates(g).into_iter(),
        "they equal an earlier Gaussian bit by bit",
    );
    if let Some(never_seen) = never_seen {
        assert_eq!(never_seen.len(), g.len(), "one flag per Gaussian");
        found.rows(
            "never seen",
            Severity::Odd,
            "gaussians",
            (0..g.len()).filter(|row| never_seen[*row]),
            "they show in none of the recorded views, so that nothing says what they look like",
        );
    }
    check_places(field, &mut found);
    check_deformation(field, &mut found);
    if let Some(rows) = &field.identities {
        check_identities(rows, field, &mut found);
    }
    // Whatever else a load refuses.
    let mut rest = field.clone();
    if found.0.iter().any(|finding| finding.severity == Severity::Broken) {
        let _done = repair(&mut rest).map_err(|error| {
            if let HealthError::Structure(error) = error {
                found.structure(&Err(error));
            }
        });
    } else {
        found.structure(&rest.validate());
    }
    found.0
}

/// Repairs what is broken, leaves what is odd, and says what was done.
///
/// # Errors
/// When a rule is broken that no repair mends, or nothing that can be drawn is left. The field is then in an
/// undefined state.
pub fn repair(field: &mut Field) -> Result<Vec<Repair>, HealthError> {
    let mut done = Vec::new();
    let mut report = |count: usize, what: &str| {
        if count > 0 {
            done.push(Repair { what: what.to_owned(), count });
        }
    };
    if !lengths_agree(&field.gaussians) {
        field.gaussians.validate()?;
    }
    let n = field.gaussians.len();
    if let Some(tracks) = &field.tracks {
        tracks.validate(n)?;
    }
    if let Some(rows) = &mut field.identities {
        let mended = mend_identities(rows);
        report(mended, "entries of identities that were not finite take the value that training starts with");
        if rows.validate(n, field.instances.len()).is_err() {
            field.identities = None;
            report(
                1,
                "the identity rows did not fit the Gaussians and were left out; cif train --from makes new ones",
            );
        }
    }
    let renamed = mend_names(field);
    report(renamed, "names with NUL characters go without them");
    let clamped = clamp_scales(&mut field.gaussians);
    report(clamped, "log-scales outside -20 to 10 take the limit that the renderer clamps them to");
    let drawable: Vec<u32> =
        (0..n).filter(|row| is_drawable(&field.gaussians, *row)).map(|row| row as u32).collect();
    if drawable.is_empty() {
        return Err(HealthError::NothingLeft { gaussians: n });
    }
    if drawable.len() < n {
        *field = field.gather(&drawable);
        report(n - drawable.len(), "Gaussians that cannot be drawn were removed");
    }
    if let Some(deformation) = &mut field.deformation {
        let planes = replace_bad(&mut deformation.planes, 1.0);
        report(planes, "features of the deformation that were not finite are 1, which changes nothing");
        let mlp = replace_bad(&mut deformation.mlp, 0.0);
        report(mlp, "weights of the deformation that were not finite are 0; what moves may move differently");
        if matches!(deformation.validate(), Err(FieldError::Bounds { .. })) {
            let around =
                Bounds::around(field.gaussians.means.iter().map(|mean| DVec3::from(mean.map(f64::from))));
            let margin = DVec3::splat(around.size().max_element().max(1e-3) * 1e-3);
            deformation.bounds = Bounds { low: around.low - margin, high: around.high + margin };
            report(1, "the box of the deformation is that of the Gaussians; what moves may move differently");
        }
    }
    if !(field.extent.is_finite() && field.extent > 0.0) {
        field.extent = 1.0;
        report(1, "the extent was no length and is 1");
    }
    field.validate()?;
    Ok(done)
}

/// Findings in the order they are reported.
#[derive(Default)]
struct Findings(Vec<Finding>);

impl Findings {
    fn rows(
        &mut self,
        check: &'static str,
        severity: Severity,
        array: &'static str,
        rows: impl Iterator<Item = usize>,
        meaning: &str,
    ) {
        let mut first = Vec::new();
        let mut count = 0;
        for row in rows {
            count += 1;
            if first.len() < NAMED {
                first.push(row);
            }
        }
        if count > 0 {
            self.0.push(Finding { check, severity, array, count, first, meaning: meaning.to_owned() });
        }
    }

    fn structure(&mut self, result: &Result<(), FieldError>) {
        if let Err(error) = result {
            self.0.push(Finding {
                check: "structure",
                severity: Severity::Broken,
                array: "scene",
                count: 1,
                first: Vec::new(),
                meaning: error.to_string(),
            });
        }
    }
}

fn lengths_agree(g: &Gaussians) -> bool {
    g.tensors().iter().all(|(parameter, values)| values.len() == g.len() * parameter.width())
}

fn check_finite(g: &Gaussians, found: &mut Findings) {
    const MEANING: &str = "such Gaussians are not drawn, and a scene with them is not loaded";
    for (parameter, values) in g.tensors() {
        let rows = values.chunks_exact(parameter.width()).enumerate();
        let bad = rows.filter(|(_, row)| row.iter().any(|value| !value.is_finite()));
        found.rows("not finite", Severity::Broken, parameter.name, bad.map(|(row, _)| row), MEANING);
    }
}

fn check_shapes(g: &Gaussians, found: &mut Findings) {
    let finite = |row: &usize| g.quaternions[*row].iter().all(|value| value.is_finite());
    found.rows(
        "degenerate",
        Severity::Broken,
        "quaternions",
        (0..g.len()).filter(finite).filter(|row| quaternion::try_normalize(g.quaternions[*row]).is_none()),
        "their norm is 0, so that they have no rotation, are not drawn, and get no gradient",
    );
    let (low, high) = LOG_SCALE_RANGE;
    let clamped = |row: &usize| {
        let scales = g.log_scales[*row];
        // Flat splats of files are meant to be flat.
        scales.iter().all(|s| s.is_finite())
            && !scales.iter().all(|s| *s < FLAT_LOG_SCALE || (low..=high).contains(s))
    };
    found.rows(
        "degenerate",
        Severity::Broken,
        "log_scales",
        (0..g.len()).filter(clamped),
        "they lie outside -20 to 10, where the renderer clamps them and they get no gradient",
    );
    let aspect = |row: &usize| {
        let scales = g.scale(*row);
        let (low, high) =
            (scales.iter().copied().fold(f32::MAX, f32::min), scales.iter().copied().fold(0.0, f32::max));
        high > MAX_ASPECT * low
    };
    found.rows(
        "needle or pancake",
        Severity::Odd,
        "log_scales",
        (0..g.len()).filter(|row| g.log_scales[*row].iter().all(|s| s.is_finite())).filter(aspect),
        "their longest axis is more than 10 000 times the shortest",
    );
}

/// Rows that equal an earlier one.
fn duplicates(g: &Gaussians) -> Vec<usize> {
    let bits = |row: usize| -> [u32; 11] {
        let (m, s, q) = (g.means[row], g.log_scales[row], g.quaternions[row]);
        [m[0], m[1], m[2], s[0], s[1], s[2], q[0], q[1], q[2], q[3], g.opacity_logits[row]].map(f32::to_bits)
    };
    let same_color = |a: usize, b: usize| {
        g.sh_coefficients[a].iter().zip(&g.sh_coefficients[b]).all(|(a, b)| a.to_bits() == b.to_bits())
    };
    let mut earlier: BTreeMap<[u32; 11], Vec<usize>> = BTreeMap::new();
    let mut rows = Vec::new();
    for row in 0..g.len() {
        let same = earlier.entry(bits(row)).or_default();
        if same.iter().any(|other| same_color(*other, row)) {
            rows.push(row);
        } else {
            same.push(row);
        }
    }
    rows
}

fn check_places(field: &Field, found: &mut Findings) {
    let means = &field.gaussians.means;
    let at = |row: usize| DVec3::from_array(means[row].map(f64::from));
    if let Some(deformation) = &field.deformation {
        let Bounds { low, high } = deformation.bounds;
        found.rows(
            "out of bounds",
            Severity::Odd,
            "means",
            (0..means.len()).filter(|row| {
                let mean = at(*row);
                mean.is_finite() && !(mean.cmpge(low).all() && mean.cmple(high).all())
            }),
            "they lie outside the box of the deformation and move as its nearest face does",
        );
    }
    if field.cameras.is_empty() || !(field.extent.is_finite() && field.extent > 0.0) {
        return;
    }
    let centres = field.cameras.iter().map(|record| record.camera.centre());
    let middle = centres.sum::<DVec3>() / field.cameras.len() as f64;
    let reach = FAR * f64::from(field.extent);
    found.rows(
        "far away",
        Severity::Odd,
        "means",
        (0..means.len()).filter(|row| at(*row).is_finite() && at(*row).distance(middle) > reach),
        "they are more than 100 extents away from the cameras",
    );
}

fn check_deformation(field: &Field, found: &mut Findings) {
    let Some(deformation) = &field.deformation else { return };
    let bad = |values: &[f32]| {
        let rows: Vec<usize> = (0..values.len()).filter(|at| !values[*at].is_finite()).collect();
        rows.into_iter()
    };
    let meaning = "Gaussians that read them are not drawn, and a scene with them is not loaded";
    found.rows("not finite", Severity::Broken, "deformation.planes", bad(&deformation.planes), meaning);
    found.rows("not finite", Severity::Broken, "deformation.mlp", bad(&deformation.mlp), meaning);
    if let Err(error @ FieldError::Bounds { .. }) = deformation.validate() {
        found.0.push(Finding {
            check: "degenerate",
            severity: Severity::Broken,
            array: "deformation.bounds",
            count: 1,
            first: Vec::new(),
            meaning: error.to_string(),
        });
    }
}

fn check_identities(rows: &Identities, field: &Field, found: &mut Findings) {
    let bad = |values: &[f32]| {
        let entries: Vec<usize> = (0..values.len()).filter(|at| !values[*at].is_finite()).collect();
        entries.into_iter()
    };
    let meaning = "the labels of these Gaussians cannot be told, and a scene with them is not loaded";
    found.rows("not finite", Severity::Broken, "identities.log_estimates", bad(&rows.log_estimates), meaning);
    found.rows(
        "not finite",
        Severity::Broken,
        "identities.log_calibrations",
        bad(&rows.log_calibrations),
        meaning,
    );
    let mut mended = rows.clone();
    mend_identities(&mut mended);
    if let Err(error) = mended.validate(field.gaussians.len(), field.instances.len()) {
        found.0.push(Finding {
            check: "structure",
            severity: Severity::Broken,
            array: "identities",
            count: 1,
            first: Vec::new(),
            meaning: error.to_string(),
        });
    }
}

fn is_drawable(g: &Gaussians, row: usize) -> bool {
    g.means[row].iter().all(|value| value.is_finite())
        && g.log_scales[row].iter().all(|value| value.is_finite())
        && quaternion::try_normalize(g.quaternions[row]).is_some()
        && g.quaternions[row].iter().all(|value| value.is_finite())
        && g.opacity_logits[row].is_finite()
        && g.occupancy_logits[row].is_finite()
        && g.sh_coefficients[row].iter().all(|value| value.is_finite())
}

/// Finite log-scales into the range; how many Gaussians changed.
fn clamp_scales(g: &mut Gaussians) -> usize {
    let (low, high) = LOG_SCALE_RANGE;
    let mut changed = 0;
    for scales in &mut g.log_scales {
        let is_kept = |s: f32| !s.is_finite() || s < FLAT_LOG_SCALE;
        let clamped = scales.map(|s| if is_kept(s) { s } else { s.clamp(low, high) });
        changed += usize::from(
            clamped.iter().zip(&*scales).any(|(a, b)| a.to_bits() != b.to_bits() && b.is_finite()),
        );
        *scales = clamped;
    }
    changed
}

fn replace_bad(values: &mut [f32], by: f32) -> usize {
    let mut replaced = 0;
    for value in values.iter_mut().filter(|value| !value.is_finite()) {
        (*value, replaced) = (by, replaced + 1);
    }
    replaced
}

/// Takes NUL characters out of the names of instances and cameras.
fn mend_names(field: &mut Field) -> usize {
    let of_instances = field
        .instances
        .iter_mut()
        .flat_map(|one| [&mut one.label, &mut one.category].into_iter().chain(one.taxonomies.values_mut()));
    let names = of_instances.chain(field.cameras.iter_mut().map(|record| &mut record.name));
    let mut mended = 0;
    for name in names.filter(|name| name.contains('\0')) {
        name.retain(|character| character != '\0');
        mended += 1;
    }
    mended
}

/// Calibrations that are not finite become 0, estimates the smallest of their row.
fn mend_identities(rows: &mut Identities) -> usize {
    let mut mended = replace_bad(&mut rows.log_calibrations, 0.0);
    let entries = rows.log_estimates.len();
    for pair in rows.row_offsets.windows(2) {
        let (start, end) = (pair[0] as usize, pair[1] as usize);
        if start >= end || end > entries {
            continue;
        }
        let row = &mut rows.log_estimates[start..end];
        let smallest = row.iter().copied().filter(|v| v.is_finite()).fold(0.0, f32::min);
        mended += replace_bad(row, smallest);
    }
    mended
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing;

    fn found(field: &Field) -> Vec<(&'static str, &'static str, usize, Vec<usize>, Severity)> {
        check(field, None).into_iter().map(|f| (f.check, f.array, f.count, f.first, f.severity)).collect()
    }

    #[test]
    fn a_sound_field_has_nothing_broken_and_needs_no_repair() {
        let mut field = testing::field(40, 1);
        assert!(check(&field, None).iter().all(|finding| finding.severity == Severity::Odd));
        let before = field.clone();
        assert!(repair(&mut field).unwrap().is_empty());
        assert_eq!(field, before);
    }

    #[test]
    fn every_kind_of_damage_is_found_and_repaired() {
        let mut field = testing::field(40, 1);
        field.tracks = None;
        let sound = found(&field);
        let g = &mut field.gaussians;
        g.means[3][1] = f32::NAN;
        g.log_scales[4][0] = f32::INFINITY;
        g.log_scales[5] = [12.0, -3.0, -25.0];
        g.quaternions[6] = [0.0; 4];
        g.quaternions[7][2] = f32::NAN;
        g.opacity_logits[8] = f32::NEG_INFINITY;
        g.occupancy_logits[9] = 40.0;
        g.opacity_logits[10] = -40.0;
        g.sh_coefficients[11][47] = f32::NAN;
        g.means[12] = [9.0, 0.0, 0.0];
        let deformation = field.deformation.as_mut().unwrap();
        deformation.planes[17] = f32::NAN;
        deformation.mlp[2] = f32::INFINITY;
        deformation.bounds.high = deformation.bounds.low;
        let rows = field.identities.as_mut().unwrap();
        rows.log_estimates[0] = f32::NAN;
        rows.log_calibrations[1] = f32::INFINITY;
        field.extent = f32::NAN;
        let all = found(&field);
        for expected in [
            ("not finite", "means", 1, vec![3], Severity::Broken),
            ("not finite", "log_scales", 1, vec![4], Severity::Broken),
            ("not finite", "quaternions", 1, vec![7], Severity::Broken),
            ("not finite", "opacity_logits", 1, vec![8], Severity::Broken),
            ("not finite", "sh_coefficients", 1, vec![11], Severity::Broken),
            ("degenerate", "quaternions", 1, vec![6], Severity::Broken),
            ("degenerate", "log_scales", 1, vec![5], Severity::Broken),
            ("saturated", "opacity_logits", 2, vec![8, 10], Severity::Odd),
            ("saturated", "occupancy_logits", 1, vec![9], Severity::Odd),
            ("not finite", "deformation.planes", 1, vec![17], Severity::Broken),
            ("not finite", "deformation.mlp", 1, vec![2], Severity::Broken),
            ("degenerate", "deformation.bounds", 1, vec![], Severity::Broken),
            ("not finite", "identities.log_estimates", 1, vec![0], Severity::Broken),
            ("not finite", "identities.log_calibrations", 1, vec![1], Severity::Broken),
        ] {
            assert!(all.contains(&expected), "{expected:?} is missing in {all:?}");
            assert!(!sound.contains(&expected), "{expected:?} was there before");
        }
        assert!(field.validate().is_err());
        let before = field.gaussians.clone();
        let repairs = repair(&mut field).unwrap();
        field.validate().unwrap();
        assert_eq!(field.len(), 40 - 6, "{repairs:?}");
        assert!(repairs.iter().any(|repair| repair.what.contains("removed") && repair.count == 6));
        // Rows that were sound are what they were; the clamped one has its limits.
        assert_eq!(field.gaussians.means[..3], before.means[..3]);
        assert_eq!(field.gaussians.log_scales[3], [10.0, -3.0, -20.0]);
        assert!(repair(&mut field).unwrap().is_empty(), "a repaired field is sound");
        assert!(check(&field, None).iter().all(|finding| finding.severity == Severity::Odd));
    }

    #[test]
    fn flat_splats_of_files_are_sound() {
        let mut field = testing::field(10, 1);
        field.gaussians.log_scales[4][1] = f32::MIN_POSITIVE.ln();
        assert!(check(&field, None).iter().all(|finding| finding.severity == Severity::Odd));
        let before = field.gaussians.clone();
        assert!(repair(&mut field).unwrap().is_empty());
        assert_eq!(field.gaussians, before);
    }

    #[test]
    fn copies_and_unseen_gaussians_are_reported() {
        let mut field = testing::field(10, 2);
        let sources = [0, 1, 1, 2, 1];
        field.tracks = None;
        let field = field.gather(&sources);
        let never_seen = [false, true, false, false, true];
        let findings = check(&field, Some(&never_seen));
        let of = |check: &str| findings.iter().find(|f| f.check == check).unwrap();
        assert_eq!((of("duplicated").count, &of("duplicated").first[..]), (2, &[2, 4][..]));
        assert_eq!((of("never seen").count, &of("never seen").first[..]), (2, &[1, 4][..]));
        let mut other = field.clone();
        other.gaussians.sh_coefficients[4][9] += 0.5;
        let again = check(&other, None);
        assert_eq!(again.iter().find(|f| f.check == "duplicated").unwrap().count, 1, "colours count");
    }

    #[test]
    fn identities_that_do_not_fit_are_left_out_and_reported() {
        let mut field = testing::field(10, 3);
        field.identities.as_mut().unwrap().row_offsets[4] = u32::MAX;
        assert!(found(&field).iter().any(|f| (f.0, f.1) == ("structure", "identities")));
        let repairs = repair(&mut field).unwrap();
        assert!(field.identities.is_none() && repairs[0].what.contains("cif train --from"), "{repairs:?}");
    }

    #[test]
    fn names_that_would_be_cut_in_usd_are_refused_and_mended() {
        let mut field = testing::field(10, 3);
        field.instances[0].label = "red\0 mug".to_owned();
        field.cameras[0].name = "left\0".to_owned();
        let error = field.validate().unwrap_err().to_string();
        assert!(error.contains("NUL") && error.contains("instance 0"), "{error}");
        assert!(found(&field).iter().any(|f| f.0 == "structure"));
        let repairs = repair(&mut field).unwrap();
        assert_eq!((repairs[0].count, field.instances[0].label.as_str()), (2, "red mug"), "{repairs:?}");
        field.validate().unwrap();
    }

    #[test]
    fn what_cannot_be_repaired_is_refused() {
        let mut field = testing::field(10, 4);
        field.timeline.times.clear();
        assert!(found(&field).iter().any(|f| f.0 == "structure"));
        assert!(matches!(repair(&mut field), Err(HealthError::Structure(_))));
        let mut field = testing::field(3, 4);
        field.gaussians.quaternions.fill([0.0; 4]);
        let error = repair(&mut field).unwrap_err();
        assert!(error.to_string().contains("not one of 3 Gaussians"), "{error}");
    }
}
