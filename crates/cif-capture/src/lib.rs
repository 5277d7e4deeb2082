//! Captures out of videos and photographs: frames, camera poses with a verdict, scale and up axis.
//!
//! | module | answers |
//! |---|---|
//! | [`source`] | which cameras the given files and folders are |
//! | [`frames`] | which images are taken of them, when, and what is wrong with them |
//! | [`structure`] | where the cameras were, through pycolmap, and whether to believe it |
//! | [`import`] | the same from files of other tools |
//! | [`poses`] | lenses, poses and points |
//! | [`similarity`] | similarity transforms, and how far two sets of poses are apart |
//! | [`world`] | the direction of up, and the length of a metre |
//! | [`known_length`] | the same from an object of known length |
//! | [`masks`] | what moves, and is left out |
//! | [`times`] | tables of times by file name |
//! | [`write`](mod@write) | the capture as nerfstudio's `transforms.json` |
//! | [`unfinished`] | what is kept where no capture is written |
//!
//! Cameras look along +z with x right and y down until they are written. The same input gives the same
//! capture, whatever the number of threads.

mod child;
mod error;
pub mod frames;
pub mod import;
pub mod known_length;
pub mod masks;
mod picture;
pub mod poses;
pub mod similarity;
pub mod source;
pub mod structure;
pub mod times;
pub mod unfinished;
pub mod world;
pub mod write;

pub use error::Error;
pub use picture::Impression;

/// Work that goes on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress<'a> {
    /// A few words about it.
    pub words: &'a str,
    /// How much of it is done, and of how much; `None` where nothing is counted.
    pub count: Option<(usize, usize)>,
}

/// Questions to the caller while work goes on.
#[derive(Clone, Copy)]
pub struct Hooks<'a> {
    /// True where the work is to end.
    pub should_stop: &'a (dyn Fn() -> bool + Sync),
    /// Takes what is being done.
    pub progress: &'a (dyn Fn(Progress<'_>) + Sync),
}

impl Hooks<'_> {
    /// Goes on to the end without a word.
    #[must_use]
    pub fn silent() -> Self {
        Self { should_stop: &|| false, progress: &|_| () }
    }

    fn say(&self, words: &str) {
        (self.progress)(Progress { words, count: None });
    }

    fn count(&self, words: &str, done: usize, total: usize) {
        (self.progress)(Progress { words, count: Some((done, total)) });
    }

    fn go_on(&self) -> Result<(), Error> {
        if (self.should_stop)() { Err(Error::Stopped) } else { Ok(()) }
    }
}
