//! Scores propagation against the exact masks of a capture: every STEP-th frame of its first camera is a keyframe, or
//! those that are listed, and the others are compared. With a folder, the masks are written into it.
//!
//! `cargo run --release -p cif-masks --example score_propagation -- CAPTURE STEP|FRAME,FRAME,... [DIR]`

use std::collections::BTreeMap;
use std::time::Instant;

use cif_dataset::masks::MaskWriter;
use cif_dataset::{Dataset, OpenOptions};
use cif_geometry::PixelGrid;
use cif_masks::{Clip, Keyframe, Mask, propagate};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().collect();
    let [_, capture, keys, folder @ ..] = &arguments[..] else {
        return Err("give a capture, and a step or frames".into());
    };
    let dataset = Dataset::open(capture, &OpenOptions::default())?;
    let camera = &dataset.frames[0].camera_name;
    let frames: Vec<usize> =
        (0..dataset.frames.len()).filter(|k| dataset.frames[*k].camera_name == *camera).collect();
    let truth = frames
        .iter()
        .map(|k| dataset.load_mask(*k)?.ok_or_else(|| "a frame without a mask".into()))
        .collect::<Result<Vec<PixelGrid<u16>>, Box<dyn std::error::Error>>>()?;
    let last = frames.len() - 1;
    let keys: Vec<usize> = match keys.parse() {
        Ok(step) => (0..last).step_by(step).chain([last]).collect(),
        Err(_) => keys.split(',').map(str::parse).collect::<Result<_, _>>()?,
    };
    let keyframes: BTreeMap<usize, Keyframe> =
        keys.iter().map(|k| (*k, Keyframe::painted(truth[*k].clone()))).collect();

    let mut masks: Vec<Option<Mask>> = vec![None; frames.len()];
    let image = |k: usize| Ok(dataset.load_image(frames[k], [1.0; 3])?);
    let clip = Clip { frames: frames.len(), image: &image, keyframes: &keyframes, stop: &|| false };
    let start = Instant::now();
    propagate(&clip, &mut |frame, mask| {
        masks[frame] = Some(mask);
        Ok(())
    })?;
    let milliseconds = start.elapsed().as_secs_f64() * 1e3 / frames.len() as f64;

    if let [folder] = folder {
        let writer = MaskWriter::create(folder.as_ref())?;
        for (frame, mask) in frames.iter().zip(masks.iter().flatten()) {
            writer.add(&dataset.frames[*frame].name, &mask.ids, Some(&mask.confidence))?;
        }
        writer.finish(&dataset.instances)?;
    }
    let others: Vec<(&Mask, &PixelGrid<u16>)> = (0..frames.len())
        .filter(|k| !keyframes.contains_key(k))
        .filter_map(|k| Some((masks[k].as_ref()?, &truth[k])))
        .collect();
    let scores: Vec<f64> =
        dataset.instances.iter().map(|instance| mean_overlap(&others, instance.id)).collect();
    for (instance, score) in dataset.instances.iter().zip(&scores) {
        println!("{:>20} {score:.3}", instance.label);
    }
    println!("confidence  share of pixels  right");
    for low in (0..250).step_by(25) {
        let bin: Vec<bool> = others
            .iter()
            .flat_map(|(mask, truth)| mask.ids.pixels.iter().zip(&truth.pixels).zip(&mask.confidence.pixels))
            .filter(|(_, confidence)| (low..low + 25).contains(&i32::from(**confidence).min(249)))
            .map(|((id, truth), _)| id == truth)
            .collect();
        let right = bin.iter().filter(|right| **right).count() as f64 / bin.len().max(1) as f64;
        let share = bin.len() as f64 / (others.len() * truth[0].pixels.len()) as f64;
        println!("{:>10.2}  {:>15.4}  {right:.3}", f64::from(low) / 250.0, share);
    }
    println!(
        "{capture}: {} keyframes of {} frames, mIoU {:.3}, {milliseconds:.0} ms a frame",
        keyframes.len(),
        frames.len(),
        scores.iter().sum::<f64>() / scores.len() as f64
    );
    Ok(())
}

/// Mean over frames of intersection over union; frames in which an object neither is nor is claimed by more than 20
/// pixels do not count.
fn mean_overlap(frames: &[(&Mask, &PixelGrid<u16>)], id: u16) -> f64 {
    let scores: Vec<f64> = frames
        .iter()
        .filter_map(|(mask, truth)| {
            let (mut both, mut claimed, mut real) = (0_u32, 0_u32, 0_u32);
            for (a, b) in mask.ids.pixels.iter().zip(&truth.pixels) {
                both += u32::from(*a == id && *b == id);
                claimed += u32::from(*a == id);
                real += u32::from(*b == id);
            }
            (real > 0 || claimed > 20).then(|| f64::from(both) / f64::from(claimed + real - both))
        })
        .collect();
    scores.iter().sum::<f64>() / scores.len().max(1) as f64
}
