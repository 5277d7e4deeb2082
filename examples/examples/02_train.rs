//! Training, with progress, and saving the scene.

use cif_dataset::{Dataset, OpenOptions};
use cif_train::{Control, Preset, TrainConfig, TrainEvent, Trainer};

fn main() -> anyhow::Result<()> {
    let dataset = Dataset::open(cif_examples::capture(), &OpenOptions::default())?;
    let mut config = TrainConfig::preset(Preset::Draft, dataset.layout);
    config.report.step_every = 100;

    let mut trainer = Trainer::new(dataset, config)?;
    trainer.run(&mut |event, _view| {
        match event {
            TrainEvent::Step { stage, iteration, iterations, psnr, gaussians, .. } => {
                println!("{stage} {iteration}/{iterations}: {gaussians} Gaussians, PSNR {psnr:.2}");
            }
            TrainEvent::IdentityEstimated { instances, .. } => println!("{instances} instances found"),
            _ => {}
        }
        Control::Continue
    })?;

    let path = cif_examples::output("tabletop-mini.cif")?;
    trainer.checkpoint(false).save(&path)?;
    println!("saved {}", path.display());
    Ok(())
}
