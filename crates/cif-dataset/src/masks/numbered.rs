//! Files that are numbered as the frames of a video, such as the masks that a tracker made of all of it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::files::listing;

/// The number that the first frame of a video has among `numbers` of files, for a video of `frames` frames.
///
/// Some tools count from 0, others from 1. It is known where the numbers are as many as the frames and have no gap, or
/// where they have gaps, so that they are numbers of frames, and hold 0 or the number of frames.
///
/// # Errors
/// Where both are possible, or the numbers may count something else than frames of the video.
pub fn first_number(numbers: &BTreeSet<u64>, frames: u64) -> Result<u64, String> {
    let (Some(first), Some(last)) = (numbers.first(), numbers.last()) else {
        return Err("none of the files has a number".to_owned());
    };
    let (first, last, count) = (*first, *last, numbers.len() as u64);
    let gaps = last - first >= count;
    match (gaps, first, last) {
        (false, ..) if count == frames => Ok(first),
        (true, 0, _) if last < frames => Ok(0),
        (true, 1.., _) if last == frames => Ok(1),
        _ => Err(format!(
            "{count} numbers from {first} to {last} for a video of {frames} frames leave open which frames they are, \
             and whether the first one has the number 0 or 1"
        )),
    }
}

/// The number that a name ends in.
pub(crate) fn number_of(name: &str) -> Option<u64> {
    let digits = name.bytes().rev().take_while(u8::is_ascii_digit).count();
    name[name.len() - digits..].parse().ok()
}

/// Files right in a folder whose names are numbers and nothing else; of two with one number neither counts.
#[must_use]
pub fn numbered_files(folder: &Path, endings: &[&str]) -> BTreeMap<u64, PathBuf> {
    let mut files: BTreeMap<u64, Option<PathBuf>> = BTreeMap::new();
    for path in listing::entries(folder).unwrap_or_default() {
        let name = listing::stem(&path);
        let is_number = name.bytes().all(|byte| byte.is_ascii_digit());
        if let Some(number) =
            name.parse().ok().filter(|_| is_number && listing::has_extension(&path, endings))
        {
            files.entry(number).and_modify(|one| *one = None).or_insert(Some(path));
        }
    }
    files.into_iter().filter_map(|(number, path)| Some((number, path?))).collect()
}

/// Files of a folder by the number of the frame of a video that they show, from 0, where they are known to be numbered
/// so; else `None`.
#[must_use]
pub fn files_of_video(folder: &Path, endings: &[&str], frames: u64) -> Option<BTreeMap<u64, PathBuf>> {
    let files = numbered_files(folder, endings);
    let first = first_number(&files.keys().copied().collect(), frames).ok()?;
    Some(files.into_iter().map(|(number, path)| (number - first, path)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_count_from_where_all_frames_say_so() {
        let first = |numbers: &[u64], frames| first_number(&numbers.iter().copied().collect(), frames);
        assert_eq!(first(&[0, 1, 2, 3], 4), Ok(0));
        assert_eq!(first(&[1, 2, 3, 4], 4), Ok(1));
        assert_eq!(first(&[1001, 1002, 1003], 3), Ok(1001));
        // Gaps, and an end that only one way of counting has.
        assert_eq!(first(&[0, 3, 6], 8), Ok(0));
        assert_eq!(first(&[2, 5, 8], 8), Ok(1));
        // One too few or many, a part, and gaps in the middle: not known.
        for numbers in [&[0, 1, 2][..], &[0, 1, 2, 3, 4], &[1, 2, 3], &[2, 3], &[2], &[1, 3], &[0, 2, 9]] {
            let message = first(numbers, 4).unwrap_err();
            assert!(message.contains("leave open"), "{numbers:?}: {message}");
        }
        assert!(first(&[], 4).is_err());
    }

    #[test]
    fn only_bare_numbers_count() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["00000.png", "1.png", "00002.png", "2.png", "a3.png", "4.txt"] {
            std::fs::write(folder.path().join(name), b"x").unwrap();
        }
        let files = numbered_files(folder.path(), &["png"]);
        assert_eq!(files.keys().copied().collect::<Vec<_>>(), [0, 1]);
        assert!(files_of_video(folder.path(), &["png"], 2).is_some());
        assert!(files_of_video(folder.path(), &["png"], 3).is_none());
    }
}
