//! Points to start training from, where a capture has none: those that its own images show by its own poses.

use cif_capture::Hooks;
use cif_capture::structure::points_of_capture;
use cif_dataset::{Dataset, PointSource};
use cif_train::{Phase, Phases};

use crate::error::Error;

/// Fewest points that are taken instead of ones drawn at random. Of fewer most of a scene would start empty; the number is
/// not measured.
const FEWEST: usize = 100;

/// Triangulates points of a capture that has none through pycolmap, and gives them to `dataset`; true where there are
/// enough. What came of it is noted among the notes of the capture; points that are there are left alone.
///
/// # Errors
/// When the run is stopped, or the file system refuses.
pub fn find(dataset: &mut Dataset, phases: &Phases) -> Result<bool, Error> {
    if dataset.points.source != PointSource::Random || dataset.train_frames().len() < 2 {
        return Ok(true);
    }
    let _phase = phases.enter(Phase::Points, 0);
    let work = cif_output::Workplace::create("cif-points-")
        .map_err(Error::io("create a temporary folder in", &std::env::temp_dir()))?;
    let hooks = Hooks { should_stop: &|| phases.is_stopped(), progress: &|_| {} };
    let root = dataset.root.display().to_string();
    let missed = match points_of_capture(dataset, work.path(), rayon::current_num_threads(), &hooks) {
        Ok(points) if points.len() >= FEWEST => {
            dataset.points.positions =
                points.iter().map(|point| point.position.as_vec3().to_array()).collect();
            dataset.points.colors = points.iter().map(|point| point.color).collect();
            dataset.points.source = PointSource::Triangulated;
            dataset.notes.push(format!(
                "{root}: it has no points; {} were triangulated from its images by its own poses",
                points.len()
            ));
            return Ok(true);
        }
        Ok(points) => format!("{} are seen by enough of its images to be triangulated", points.len()),
        Err(cif_capture::Error::Stopped) => return Err(cif_capture::Error::Stopped.into()),
        Err(error) => format!("none could be triangulated: {error}"),
    };
    dataset.notes.push(format!(
        "{root}: it has no points, and {missed}; training starts from {} points drawn at random, which shows less (pip \
         install 'cif4d[capture]' brings pycolmap, which finds points)",
        dataset.points.positions.len()
    ));
    Ok(false)
}
