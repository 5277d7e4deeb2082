//! Errors of reading a capture, for the person at the keyboard: each message names the file and the fix.

use std::io;
use std::path::{Path, PathBuf};

use crate::Layout;

/// A capture could not be read, or its masks could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The folder does not exist.
    #[error("{}: there is no such folder; give the folder of a capture", path.display())]
    MissingFolder {
        /// The path that was asked for.
        path: PathBuf,
    },
    /// A file stands where the capture should be.
    #[error("{}: this is a file; give the folder that holds the capture", path.display())]
    NotAFolder {
        /// The path that was asked for.
        path: PathBuf,
    },
    /// Nothing in the folder marks a layout.
    #[error(
        "{}: no capture layout fits; looked for dataset.json (HyperNeRF), train_meta.json (Dynamic 3D Gaussians), \
         poses_bounds.npy (Neu3D, LLFF), transforms_train.json or transforms_test.json (D-NeRF), transforms.json \
         (nerfstudio) and sparse/0 (COLMAP){hint}",
        root.display()
    )]
    NoLayout {
        /// Folder of the capture.
        root: PathBuf,
        /// Subfolder that would fit, in words; empty when there is none.
        hint: String,
    },
    /// Two layouts fit equally well.
    #[error(
        "{}: two layouts fit, {first} ({}) and {second} ({}); choose one with --layout {first} or --layout \
         {second}",
        root.display(), first.marker(), second.marker()
    )]
    TwoLayouts {
        /// Folder of the capture.
        root: PathBuf,
        /// One layout that fits.
        first: Layout,
        /// The other.
        second: Layout,
    },
    /// A file of the capture is missing.
    #[error("{}: missing; {fix}", path.display())]
    MissingFile {
        /// The file.
        path: PathBuf,
        /// Remedy.
        fix: String,
    },
    /// A file could not be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file or folder could not be written.
    #[error("{}: cannot be written: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A JSON file does not parse, or does not hold what its layout asks for.
    #[error("{}:{line}:{column}: {problem}", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// Message of the parser.
        problem: String,
    },
    /// A camera has no image.
    #[error(
        "frame {frame}: {} names its camera, but the image {} is missing{}; restore the image or remove the \
         frame",
        source_file.display(), image.display(), instead_of(image)
    )]
    CameraWithoutImage {
        /// Frame of the capture.
        frame: String,
        /// File that holds or lists the camera.
        source_file: PathBuf,
        /// Where the image should be.
        image: PathBuf,
    },
    /// An image has no camera.
    #[error(
        "image {}: its camera {} is missing; restore the camera file or remove the frame",
        image.display(), camera.display()
    )]
    ImageWithoutCamera {
        /// The image.
        image: PathBuf,
        /// Where the camera should be.
        camera: PathBuf,
    },
    /// The name of a frame cannot name files in a folder.
    #[error(
        "{}: the name of frame {frame:?} {problem}; name images by paths inside the folder of the capture",
        path.display()
    )]
    FrameName {
        /// File that lists the frame.
        path: PathBuf,
        /// Frame of the capture.
        frame: String,
        /// The problem, as the predicate of the message.
        problem: &'static str,
    },
    /// Two frames share a name.
    #[error("{}: frame {frame} is listed twice; keep one of the two", path.display())]
    DuplicateFrame {
        /// File that lists the frames.
        path: PathBuf,
        /// Frame of the capture.
        frame: String,
    },
    /// A camera pose is not a rotation and a position.
    #[error("{}: the pose of frame {frame} {problem}; correct it or remove the frame", path.display())]
    Pose {
        /// File that holds the pose.
        path: PathBuf,
        /// Frame of the capture.
        frame: String,
        /// The problem, as the predicate of the message.
        problem: String,
    },
    /// A camera's focal length, principal point, size or lens makes no sense.
    #[error("{}: frame {frame}: {problem}", path.display())]
    Intrinsics {
        /// File that holds the camera.
        path: PathBuf,
        /// Frame of the capture.
        frame: String,
        /// The problem and what is expected.
        problem: String,
    },
    /// An image cannot be decoded.
    #[error("{}: cannot be decoded ({problem}); copy or export the image again", path.display())]
    Image {
        /// The image.
        path: PathBuf,
        /// Message of the decoder.
        problem: String,
    },
    /// A mask cannot be decoded.
    #[error("{}: cannot be used as a mask: {problem}", path.display())]
    Mask {
        /// The mask.
        path: PathBuf,
        /// The problem and what is expected.
        problem: String,
    },
    /// A confidence of a mask cannot be decoded, or does not belong to its image.
    #[error(
        "{}: cannot be used as the confidence of a mask: {problem}; write it again as an 8-bit grey PNG of the size \
         of the mask, 255 for certain, or remove it",
        path.display()
    )]
    Confidence {
        /// The confidence.
        path: PathBuf,
        /// The problem.
        problem: String,
    },
    /// A mask and its image differ in shape.
    #[error(
        "{}: the mask has {} x {} pixels, its image {} has {} x {}: another aspect; export the mask at the \
         size of the image",
        mask.display(), mask_size.0, mask_size.1, image.display(), image_size.0, image_size.1
    )]
    MaskSize {
        /// The mask.
        mask: PathBuf,
        /// Width and height of the mask.
        mask_size: (u32, u32),
        /// The image.
        image: PathBuf,
        /// Width and height of the image.
        image_size: (u32, u32),
    },
    /// The mask folder that was asked for holds no mask of this capture.
    #[error("{}: {problem}", folder.display())]
    MaskFolder {
        /// The folder that was asked for.
        folder: PathBuf,
        /// The problem and what would fit.
        problem: String,
    },
    /// A video has to be decoded, but there is no ffmpeg.
    #[error(
        "{}: this capture keeps its frames in a video, and ffmpeg is not on the PATH; install ffmpeg, or extract \
         the frames into {} as 0000.png, 0001.png, ...",
        video.display(), images.display()
    )]
    FfmpegMissing {
        /// The video.
        video: PathBuf,
        /// Folder where extracted frames are found.
        images: PathBuf,
    },
    /// ffmpeg failed on a video.
    #[error("{}: ffmpeg could not extract the frames: {problem}", video.display())]
    Ffmpeg {
        /// The video.
        video: PathBuf,
        /// First lines of the errors of ffmpeg.
        problem: String,
    },
    /// A file holds something else than it should.
    #[error("{}: {problem}", path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The problem and what is expected.
        problem: String,
    },
}

/// A word on the image that may be meant by one that is missing: of the same name in capitals or with another ending.
fn instead_of(image: &Path) -> String {
    let plain = |path: &Path| path.file_stem().map(|stem| stem.to_string_lossy().to_lowercase());
    let is_image = |path: &Path| {
        let ending = path.extension().map(|ending| ending.to_string_lossy().to_lowercase());
        ending.is_some_and(|ending| ["png", "jpg", "jpeg"].contains(&ending.as_str()))
    };
    let Some(Ok(entries)) = image.parent().map(std::fs::read_dir) else { return String::new() };
    let mut meant = entries.flatten().map(|entry| entry.path()).filter(|other| is_image(other));
    let meant = meant.find(|other| plain(other) == plain(image));
    let name = meant.as_deref().and_then(Path::file_name);
    name.map_or_else(String::new, |name| format!(" (there is {})", name.to_string_lossy()))
}

impl Error {
    pub(crate) fn invalid(path: &Path, problem: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), problem: problem.into() }
    }

    pub(crate) fn mask(path: &Path, problem: impl Into<String>) -> Self {
        Self::Mask { path: path.to_owned(), problem: problem.into() }
    }

    pub(crate) fn read(path: &Path) -> impl FnOnce(io::Error) -> Self + '_ {
        move |source| Self::Read { path: path.to_owned(), source }
    }

    pub(crate) fn write(path: &Path) -> impl FnOnce(io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.to_owned(), source }
    }
}
