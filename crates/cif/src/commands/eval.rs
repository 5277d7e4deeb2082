//! `cif eval`: scores a scene on the held-out frames of a capture.

use std::path::PathBuf;

use cif_field::Field;
use cif_train::heads::Decoder;
use cif_train::metrics::{Evaluation, EvaluationError, EvaluationOptions, FrameView, evaluate};
use clap::Args;

use super::shared::simd::Simd;
use super::shared::split::SplitName;
use super::shared::table::number;
use super::shared::{motion, scene};
use crate::commands::shared::{CaptureOptions, print_misfits, print_warnings};
use crate::error::Error;
use crate::evaluation::{label_of, report_of};
use crate::messages::outcome;
use crate::output::Outputs;
use crate::pictures::{
    Picture, depth_picture, error_picture, instance_picture, rgb_picture, save_rgb, side_by_side,
};
use crate::report::Report;
use crate::{endings, interrupt, output};

/// Score a scene on the held-out frames of a capture
#[derive(Debug, Args)]
#[command(after_help = "\
PSNR and SSIM are means over images (SSIM: 11 x 11 window, zero padding). The co-visible PSNR is that of
the pixels whose surface training views show too (their share of all pixels is shown): their point, at the rendered
depth, lies inside a tenth of the training views (at least 5, out of 64 where there are more)
and at most 5 % behind the depth rendered there. It leaves out parts that no training image shows.

Instance scores are percent. PQ and IoU take pixels without a label as background, so that splats that spill onto
it count: PQ is panoptic quality (Kirillov et al. 2019), IoU the mean over pairs of instance and frame. Where masks
leave objects unlabelled, these are too low. The paper's protocol looks at labelled pixels alone: mAcc-pix per frame,
mAcc-inst per instance, mIoU per pair of instance and frame. A scene of another head (`cif train --head`) is scored by what that head decodes per pixel
(JSON: labels_by). The JSON also has the other definitions in use, and values per frame and per instance.
n/a (JSON null) means that there is nothing to measure.

Motion is measured where the capture has motion.json and tracks.npz, on what `cif export` would
write by default, over all times. Followed surface points of an instance are carried from eight
times to all others by the four nearest splats; times at which no mask shows 20 pixels of it do
not count. The table has the mean distance from the true points, the same as a share of the diagonal
of the object's true box, the same had nothing moved, the share of points within 10, 20 and 50 mm,
the median error of rotation (rigid instances that move), the largest rotation there was, what the
scene claims of it (observed, assumed or none), and the overlap (IoU) of the box of the splats with
the true one, percent. A second table counts the rigid objects that turn by more than 20 degrees by
that claim: their rotation is right where its median error is at most 15 degrees. JSON: motion.

  cif eval table.cif captures/table
  cif eval table.cif captures/table --masks masks --json scores.json --images pictures

Pictures show, side by side: truth, render, instance map (faint where instances hardly cover), error
(brightest from a quarter of full range on), depth (near is bright).")]
pub(super) struct Eval {
    /// Trained scene
    #[arg(value_name = "SCENE.cif")]
    scene: PathBuf,
    /// Folder of the capture
    capture: PathBuf,
    /// Frames to score
    #[arg(long, default_value = "val", value_name = "SPLIT")]
    split: SplitName,
    #[command(flatten)]
    report: Report,
    /// Write a picture per frame into this folder
    #[arg(long, value_name = "DIR", value_parser = endings::folder())]
    images: Option<PathBuf>,
    /// Replace existing output
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    capture_options: CaptureOptions,
    /// Vector instructions: `auto` takes the widest that the processor has
    #[arg(long, value_name = "LEVEL", default_value = "auto", value_parser = Simd::parser())]
    simd: Simd,
}

pub(super) fn run(command: &Eval) -> Result<(), Error> {
    let mut outputs = Outputs::new(command.force);
    outputs.reads(&command.scene)?;
    command.report.check(&mut outputs)?;
    let (field, decoder) = scene::load_with_head(&command.scene)?;
    let dataset = command.capture_options.as_trained(&field).open(&command.capture)?;
    print_warnings(&dataset);
    outputs.reads_capture(&dataset)?;
    for file in dataset.motion_files().iter().flatten() {
        outputs.reads(file)?;
    }
    // Read first: damaged files are reported before frames are rendered.
    let truth = dataset.motion_truth().map_err(Error::plain)?;
    print_misfits(&field, &dataset, command.split.into());
    if let Some(folder) = &command.images {
        output::check_folder(folder, command.force)?;
        for index in dataset.split_frames(command.split.into()) {
            outputs.picture(folder, &dataset.frames[index].name, "png")?;
        }
    }
    let options = EvaluationOptions {
        split: command.split.into(),
        settings: scene::render_settings(&field),
        simd: command.simd.into(),
        depth: command.images.is_some(),
        covisible: matches!(command.split, SplitName::Val),
        decoder: decoder.as_ref(),
    };
    interrupt::watch();
    let evaluation = evaluate(&field, &dataset, &options, |view| {
        interrupt::go_on()?;
        match &command.images {
            Some(folder) => save_rgb(&output::inside(folder, &view.frame.name, "png")?, &panel(&view)),
            None => Ok(()),
        }
    })?;
    let motion = match &truth {
        Some(truth) => motion::measure(&field, &dataset, truth)?,
        None => None,
    };
    let labels_by = decoder.as_ref().map(Decoder::name);
    let print = || {
        print_table(&evaluation, &field);
        if let Some(head) = labels_by {
            println!("labels as the head {head} decodes every pixel");
        }
        if let Some(motion) = &motion {
            motion.print();
        }
    };
    command.report.give(|| report_of(&evaluation, motion.as_ref(), &field, labels_by), print)?;
    if let Some(folder) = &command.images {
        outcome!("pictures in {}", folder.display());
    }
    Ok(())
}

impl From<EvaluationError> for Error {
    fn from(error: EvaluationError) -> Self {
        Self::plain(error)
    }
}

fn panel(view: &FrameView<'_>) -> Picture {
    let truth = &view.truth.image;
    let mut pictures = vec![truth.clone(), rgb_picture(&view.rendered.color)];
    if let (Some(ids), Some(layers)) = (view.predicted, &view.rendered.instances) {
        pictures.push(instance_picture(ids, &layers.foreground));
    }
    pictures.push(error_picture(&view.rendered.color, truth));
    pictures.extend(view.rendered.depth.as_ref().map(depth_picture));
    side_by_side(&pictures)
}

fn print_table(evaluation: &Evaluation, field: &Field) {
    let mut table = crate::commands::shared::table([
        "",
        "frames",
        "PSNR",
        "co-visible",
        "seen",
        "SSIM",
        "PQ",
        "IoU",
        "mAcc-pix",
        "mAcc-inst",
        "mIoU",
    ]);
    let overall = std::iter::once(("all", &evaluation.overall));
    for (name, scores) in
        overall.chain(evaluation.groups.iter().map(|(name, scores)| (name.as_str(), scores)))
    {
        table.add_row([
            name.to_owned(),
            scores.frames.to_string(),
            number(scores.psnr, 2),
            number(scores.psnr_covisible, 2),
            scores.covisible.map_or("n/a".to_owned(), |percent| format!("{percent:.0} %")),
            number(scores.ssim, 4),
            number(scores.panoptic.quality, 2),
            number(scores.panoptic.iou, 2),
            number(scores.instance.macc_pix, 2),
            number(scores.instance.macc_inst, 2),
            number(scores.instance.miou, 2),
        ]);
    }
    println!("{table}");
    if !evaluation.overall.instance.instances.is_empty() {
        let mut table = crate::commands::shared::table([
            "id", "instance", "frames", "IoU", "mIoU", "accuracy", "tube IoU", "switches",
        ]);
        for score in &evaluation.overall.instance.instances {
            table.add_row([
                score.id.to_string(),
                label_of(field, score.id),
                score.frames.to_string(),
                number(evaluation.overall.panoptic.instances.get(&score.id).copied(), 2),
                number(score.iou, 2),
                number(score.accuracy, 2),
                number(score.tube_iou, 2),
                score.id_switches.to_string(),
            ]);
        }
        println!("{table}");
    }
    if let Some(exposed) = evaluation.exposed_frames {
        let all = evaluation.frames.len();
        println!(
            "{exposed} of {all} frames compared as their camera was learnt to expose, the others as the average \
             camera sees; PSNR of all as the average camera sees {}, with the colours of each fitted {}",
            number(evaluation.overall.psnr_mean_look, 2),
            number(evaluation.overall.psnr_color_fitted, 2)
        );
    }
    println!("{} Gaussians, {:.1} ms per frame", evaluation.gaussians, evaluation.render_ms_per_frame);
}
