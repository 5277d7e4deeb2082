//! What a capture becomes, whatever its layout.

use cif_dataset::{Dataset, OpenOptions, Split};

fn main() -> anyhow::Result<()> {
    let dataset = Dataset::open(cif_examples::capture(), &OpenOptions::default())?;
    println!("{:?}: {} frames at {} times", dataset.layout, dataset.frames.len(), dataset.times.len());
    for instance in &dataset.instances {
        println!("  mask value {:>2} is {}", instance.id, instance.label);
    }

    let held_out = dataset.frames.iter().filter(|frame| frame.split == Split::Val).count();
    println!("{held_out} frames are held out; initial points: {}", dataset.points.positions.len());

    // Images stay on disk until they are asked for.
    let frame = &dataset.frames[0];
    let data = dataset.load_frame(0, [1.0; 3])?;
    let labelled = data.mask.map_or(0, |mask| mask.pixels.iter().filter(|id| **id != 0).count());
    println!(
        "frame {} at time {:.3}: {} x {} pixels, {labelled} of them labelled; camera at {:.3}",
        frame.name,
        frame.time,
        data.image.width,
        data.image.height,
        frame.camera.centre()
    );
    Ok(())
}
