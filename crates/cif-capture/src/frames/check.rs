//! Reasons why images cannot become a capture, reported before work is put into them.

use std::collections::{BTreeMap, BTreeSet};

use cif_geometry::stats::upper_median;

use super::shot::Shot;
use crate::Error;

/// Oddities that do not stop a capture, one sentence each.
pub type Notes = Vec<String>;

/// Fewer images than this have no poses that could be trusted.
const FEWEST: usize = 3;

/// Images less sharp than this share of the median of their camera are blurred.
const BLURRED: f64 = 0.2;

/// A camera whose frames change less than this, of 255, stands still.
const STILL: f64 = 2.5;

/// A few of some names.
pub(super) fn some_of(names: &[String]) -> String {
    let shown = names.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > 3 { format!("{shown}, ... ({} in all)", names.len()) } else { shown }
}

fn by_camera(shots: &[Shot]) -> BTreeMap<&str, Vec<&Shot>> {
    let mut cameras: BTreeMap<&str, Vec<&Shot>> = BTreeMap::new();
    for shot in shots {
        cameras.entry(&shot.camera).or_default().push(shot);
    }
    cameras
}

/// True where every camera has several images and none of them moves: a rig of fixed cameras, or a tripod.
#[must_use]
pub fn is_fixed(shots: &[Shot]) -> bool {
    let cameras = by_camera(shots);
    !cameras.is_empty() && cameras.values().all(|shots| shots.len() > 1 && stands_still(shots))
}

/// True where most of the picture stays as it is from the first to all other images.
fn stands_still(shots: &[&Shot]) -> bool {
    let change = |shot: &&Shot| shot.impression.change(&shots[0].impression);
    shots[1..].iter().map(change).fold(0.0, f64::max) < STILL
}

/// Checks the images of a capture; `fixed` says whether the cameras stand still.
///
/// # Errors
/// When there are too few, a camera mixes upright and lying images, or one camera alone stands still.
pub fn check(shots: &[Shot], fixed: bool, notes: &mut Notes) -> Result<(), Error> {
    let cameras = by_camera(shots);
    let names: Vec<&str> = cameras.keys().copied().collect();
    // Of two or less nothing is known of whether the camera moves.
    let fixed = fixed && shots.len() >= FEWEST;
    if fixed && cameras.len() == 1 {
        return Err(Error::stands_still(
            format!("{}: the camera stands still, and one still camera sees no depth", names[0]),
            "record while walking around the scene, give the videos of several fixed cameras, or, where only the \
             scene fills the picture with motion, say --moving",
        ));
    }
    let images = if fixed { cameras.len() } else { shots.len() };
    if images < FEWEST {
        let what = if fixed { "fixed cameras" } else { "usable images" };
        return Err(Error::refused(
            format!(
                "{images} {what} are too few: poses need {FEWEST} at the least, and should have 20 or more"
            ),
            "add images that overlap by two thirds, or take more frames with --rate or --count",
        ));
    }
    for (camera, shots) in &cameras {
        let sizes: BTreeSet<(u32, u32)> = shots.iter().map(|shot| shot.size).collect();
        if sizes.len() > 1 {
            let of = |upright: bool| shots.iter().filter(|s| (s.size.1 > s.size.0) == upright).count();
            let shown: Vec<String> = sizes.iter().take(4).map(|(w, h)| format!("{w} x {h}")).collect();
            let turned = if of(true) > 0 && of(false) > 0 {
                format!("{} upright and {} lying images are mixed", of(true), of(false))
            } else {
                "images of several sizes are mixed".to_owned()
            };
            return Err(Error::refused(
                format!("{camera}: {turned} ({})", shown.join(", ")),
                "sort them into one folder per size and give the folders together: each is a camera with a lens of \
                 its own",
            ));
        }
        let mut sharpness: Vec<f64> = shots.iter().map(|shot| shot.impression.sharpness).collect();
        let median = upper_median(&mut sharpness).unwrap_or(0.0);
        let blurred: Vec<String> = shots
            .iter()
            .filter(|shot| shot.impression.sharpness < BLURRED * median)
            .map(|shot| shot.name.clone())
            .collect();
        if !blurred.is_empty() {
            notes.push(format!(
                "{camera}: {} images are much less sharp than the others: {}",
                blurred.len(),
                some_of(&blurred)
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::Impression;
    use crate::picture::tests::board;

    fn shot(camera: &str, name: &str, size: (u32, u32), side: usize, shift: usize) -> Shot {
        Shot {
            camera: camera.to_owned(),
            name: name.to_owned(),
            file: name.into(),
            time: None,
            size,
            turned: cif_dataset::orientation::Orientation::NoTransforms,
            impression: Impression::of(&board(side, shift)),
            source: None,
        }
    }

    fn moving(count: usize) -> Vec<Shot> {
        (0..count).map(|k| shot("a", &format!("{k}.png"), (64, 48), 50, 9 * k)).collect()
    }

    #[test]
    fn captures_that_move_pass() {
        let shots = moving(5);
        let mut notes = Notes::new();
        assert!(!is_fixed(&shots));
        check(&shots, false, &mut notes).unwrap();
        assert!(notes.is_empty(), "{notes:?}");
    }

    #[test]
    fn a_still_camera_is_refused_and_a_rig_of_them_is_not() {
        let still = |camera: &str, shift| -> Vec<Shot> {
            (0..4).map(|k| shot(camera, &format!("{k}.png"), (64, 48), 50, shift)).collect()
        };
        let one = still("a", 0);
        assert!(is_fixed(&one));
        let error = check(&one, true, &mut Notes::new()).unwrap_err().to_string();
        assert!(error.contains("stands still"), "{error}");
        let rig: Vec<Shot> = ["a", "b", "c"].iter().flat_map(|name| still(name, name.len())).collect();
        assert!(is_fixed(&rig));
        check(&rig, true, &mut Notes::new()).unwrap();
        let error = check(&rig[..8], true, &mut Notes::new()).unwrap_err().to_string();
        assert!(error.contains("2 fixed cameras are too few"), "{error}");
    }

    #[test]
    fn few_and_mixed_images_are_refused() {
        let error = check(&moving(2), false, &mut Notes::new()).unwrap_err().to_string();
        assert!(error.contains("2 usable images are too few"), "{error}");
        let twice = [shot("a", "0.png", (64, 48), 50, 0), shot("a", "1.png", (64, 48), 50, 0)];
        let error = check(&twice, true, &mut Notes::new()).unwrap_err().to_string();
        assert!(error.contains("2 usable images are too few"), "{error}");
        let mut mixed = moving(5);
        mixed[2].size = (48, 64);
        let error = check(&mixed, false, &mut Notes::new()).unwrap_err().to_string();
        assert!(error.contains("1 upright and 4 lying"), "{error}");
    }

    #[test]
    fn blurred_images_are_named() {
        let mut shots = moving(5);
        shots[3].impression.sharpness *= 0.1;
        let mut notes = Notes::new();
        check(&shots, false, &mut notes).unwrap();
        assert!(notes[0].contains("3.png"), "{notes:?}");
    }
}
