//! The command line of `cif capture`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use crate::moment::Moment;

/// Make a capture out of videos or photographs: frames, camera poses, times
#[derive(Debug, Args)]
#[command(after_help = "\
Inputs are videos and folders of photographs (PNG, JPEG), one per camera; NAME=PATH names a camera. Videos need ffmpeg
on the PATH; poses need pycolmap, which `pip install 'cif4d[capture]'` brings.

  cif capture walk.mp4 -o captures/table                          150 frames of a video, the sharpest of each window
  cif capture walk.mp4 -o captures/table --rate 5 --max-side 960
  cif capture photos/ -o captures/garden                          photographs keep their names
  cif capture left=a.mp4 right=b.mp4 top=c.mp4 -o captures/rig --rate 10
  cif capture left=a.mp4 right=b.mp4 -o captures/rig --rate 10 --offset right=-0.12    right began 0.12 s earlier
  cif capture walk.mp4 -o captures/table2 --masks painted --moving-ids 1,4     what moves is left out of the poses
  cif capture walk.mp4 -o captures/table --masks masks --length 'red mug' 0.09
  cif capture photos/ -o captures/garden --poses colmap/sparse/0

Poses are found by COLMAP's global mapper; where images have few points or matches do not fit, the incremental mapper is
run too, and again with more features where the two disagree. The poses are then checked: share of images with a pose,
reprojection error, focal length, and the difference between two runs. If the check fails, no capture is written (--accept
writes it anyway); frames of videos and the poses are kept in DIR-unfinished, and the commands that continue from
there are printed. Features and matches are kept in DIR-features until a capture is written, also after Ctrl-C: another
run with the same DIR, on the same images or some of them, continues from them. Images alone fix neither scale nor up: up
is taken from how the cameras were held, the metre from --length or --measured, and the report says which of them are known.

Cameras of a rig that stand still are recognised by their images; they are solved at one moment, and triangulate points at four.
Frames of a video are named by their number in the stream (000123.png), and the capture records the video, so that
masks of all its frames, at its size, match the frames that were taken. HLG and PQ video, as phones record it, is converted
to sRGB. Photographs are turned upright, as their EXIF says; poses and masks of the stored pixels are turned with them. Times are those of the stream, or of a table: one line per image with its name, a comma, and seconds.")]
pub(in crate::commands) struct Capture {
    /// Videos and folders of photographs, one per camera
    #[arg(required = true, value_name = "INPUT")]
    pub(super) inputs: Vec<String>,
    /// New folder for the capture
    #[arg(short, long, value_name = "DIR", value_parser = crate::endings::folder())]
    pub(super) output: PathBuf,
    /// Frames per second to take of videos
    #[arg(long, value_name = "HZ", value_parser = positive, conflicts_with = "count", help_heading = "Frames")]
    pub(super) rate: Option<f64>,
    /// Frames to take of every input [default: 150 of a video, all photographs]
    #[arg(long, value_name = "N", value_parser = clap::builder::RangedU64ValueParser::<usize>::new().range(1..=100_000), help_heading = "Frames")]
    pub(super) count: Option<usize>,
    /// Time of videos to begin at, seconds with an s: 12s
    #[arg(long, value_name = "TIME", value_parser = seconds, help_heading = "Frames")]
    pub(super) from: Option<f64>,
    /// Time of videos to end at, as 20.5s
    #[arg(long, value_name = "TIME", value_parser = seconds, help_heading = "Frames")]
    pub(super) to: Option<f64>,
    /// Reduce frames of videos and photographs so that their larger side has at most so many pixels
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(16..=16_384), help_heading = "Frames")]
    pub(super) max_side: Option<u32>,
    /// Take the sharpest frame of every window, as is the default for one video
    #[arg(long, conflicts_with = "nearest", help_heading = "Frames")]
    pub(super) sharpest: bool,
    /// Take the frame nearest to the middle of every window, as is the default for several videos
    #[arg(long, help_heading = "Frames")]
    pub(super) nearest: bool,
    /// Seconds by which a camera began to record after the others, below 0 before them; may be given several times
    #[arg(long, value_name = "CAMERA=SECONDS", value_parser = offset, allow_hyphen_values = true, help_heading = "Frames")]
    pub(super) offset: Vec<(String, f64)>,
    /// Table of times: image name, comma, seconds
    #[arg(long, value_name = "FILE", help_heading = "Frames")]
    pub(super) times: Option<PathBuf>,
    /// Folder of masks, PNG files of ids named as the images: what moves is left out of the poses, and the
    /// capture gets the masks
    #[arg(long, value_name = "DIR", help_heading = "Poses")]
    pub(super) masks: Option<PathBuf>,
    /// Ids of the masks that move [default: all but 0]
    #[arg(long, value_name = "ID,...", value_delimiter = ',', requires = "masks", help_heading = "Poses")]
    pub(super) moving_ids: Option<Vec<u16>>,
    /// Focal length to start from, in pixels of the images taken [default: of EXIF, else 1.2 times the larger
    /// side]
    #[arg(long, value_name = "PIXELS", value_parser = positive, help_heading = "Poses")]
    pub(super) focal: Option<f64>,
    /// Lenses: one for all images of a size, or each camera its own
    #[arg(long, value_name = "WHICH", default_value = "one", help_heading = "Poses")]
    pub(super) lenses: LensesName,
    /// Order of the images: sequence (neighbours overlap), any (each is matched with each), or auto: sequence
    /// for videos, any for up to 120 photographs
    #[arg(long, value_name = "ORDER", default_value = "auto", help_heading = "Poses")]
    pub(super) order: OrderName,
    /// The cameras stand still: one moment gives their poses
    #[arg(long, conflicts_with = "moving", help_heading = "Poses")]
    pub(super) fixed: bool,
    /// The cameras move, although most of their image stays the same
    #[arg(long, help_heading = "Poses")]
    pub(super) moving: bool,
    /// Take poses of another tool: a COLMAP model, a nerfstudio transforms.json, a Polycam export, a
    /// RealityCapture registration (.csv), or cameras of Metashape (.xml); where it has no points, pycolmap finds them
    #[arg(long, value_name = "FROM", conflicts_with_all = ["focal", "fixed", "moving"], help_heading = "Poses")]
    pub(super) poses: Option<PathBuf>,
    /// Write the capture even if the poses fail their check
    #[arg(long, help_heading = "Poses")]
    pub(super) accept: bool,
    /// Longest side of an object of the masks that stands still, by its label or id, in metres
    #[arg(long, num_args = 2, value_names = ["LABEL", "METRES"], requires = "masks", conflicts_with = "measured", help_heading = "World")]
    pub(super) length: Option<Vec<String>>,
    /// Length between two points in metres; each point is IMAGE:X,Y of two or more images, joined by /
    #[arg(long, num_args = 3, value_names = ["POINT", "POINT", "METRES"], help_heading = "World")]
    pub(super) measured: Option<Vec<String>>,
    /// Up: cameras (from how they were held), unknown, or X,Y,Z in the world of --poses
    #[arg(
        long,
        value_name = "UP",
        default_value = "cameras",
        allow_hyphen_values = true,
        help_heading = "World"
    )]
    pub(super) up: UpName,
    #[arg(from_global)]
    pub(super) quiet: bool,
    #[command(flatten)]
    pub(super) report: crate::report::OnlyReport,
    /// A step of `cif make`, which prints the next step itself
    #[arg(long, hide = true)]
    pub(super) step: bool,
}

/// Which images share a lens.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum LensesName {
    /// All images of one size
    One,
    /// Those of a camera
    Each,
}

/// How images follow each other.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum OrderName {
    /// As the input calls for
    Auto,
    /// Neighbours overlap
    Sequence,
    /// Any two may overlap
    Any,
}

/// Where up comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum UpName {
    /// How the cameras were held.
    Cameras,
    /// Nowhere.
    Unknown,
    /// A direction in the world of the poses.
    Given([f64; 3]),
}

impl std::str::FromStr for UpName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "cameras" => Ok(Self::Cameras),
            "unknown" => Ok(Self::Unknown),
            _ => {
                let values: Option<Vec<f64>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
                let direction = values.and_then(|values| <[f64; 3]>::try_from(values).ok());
                direction
                    .filter(|d| d.iter().all(|v| v.is_finite()) && d.iter().any(|v| v.abs() > 1e-9))
                    .map(Self::Given)
                    .ok_or_else(|| "cameras, unknown or three numbers X,Y,Z are expected".to_owned())
            }
        }
    }
}

/// A number above 0.
pub(super) fn positive(text: &str) -> Result<f64, String> {
    let value = text.parse().ok().filter(|value: &f64| value.is_finite() && *value > 0.0);
    value.ok_or_else(|| "a number above 0 is expected".to_owned())
}

fn seconds(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(Moment::Seconds(value)) if value >= 0.0 => Ok(value),
        Ok(Moment::Frame(value)) => Err(format!("times of a video are seconds with an s: {value}s")),
        _ => Err("seconds from 0 on are expected, with an s: 12.5s".to_owned()),
    }
}

/// A camera and seconds.
fn offset(text: &str) -> Result<(String, f64), String> {
    let parsed = text.rsplit_once('=').and_then(|(name, seconds)| Some((name, seconds.parse().ok()?)));
    let found = parsed.filter(|(name, seconds): &(&str, f64)| !name.is_empty() && seconds.is_finite());
    let (name, seconds) = found.ok_or_else(|| "CAMERA=SECONDS is expected, as right=-0.12".to_owned())?;
    Ok((name.to_owned(), seconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_name_a_camera() {
        assert_eq!(offset("cam=2=-0.12"), Ok(("cam=2".to_owned(), -0.12)));
        for text in ["0.1", "=0.1", "cam2=", "cam2=soon", "cam2=inf"] {
            assert!(offset(text).is_err(), "{text}");
        }
    }
}
