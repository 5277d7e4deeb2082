//! Views of an object that fits are made from, and views that are left out to judge these.

use super::view::ObjectView;

/// Views of an object, by their places among all of its views.
#[derive(Clone, Debug)]
pub(super) struct SplitViews {
    /// Views that are fitted to.
    pub(super) train: Vec<usize>,
    /// Views that are left out; none where all are fitted to.
    pub(super) left_out: Vec<usize>,
}

impl SplitViews {
    /// Leaves out a camera in the middle where there are several at a time, else every fourth time; of reliable views, in
    /// the order of times.
    pub(super) fn of(views: &[ObjectView], reliable: &[usize]) -> Self {
        let good = times_of(views, reliable);
        if reliable.len() > good.len() {
            let mut cameras: Vec<[i64; 3]> = reliable.iter().map(|view| views[*view].camera_key).collect();
            cameras.sort_unstable();
            cameras.dedup();
            let middle = cameras[cameras.len() / 2];
            return Self::by(reliable, |view| views[view].camera_key == middle);
        }
        let is_left_out = |time: usize| {
            let place = good.iter().position(|other| *other == time).unwrap_or(0);
            good.len() > 8 && place >= 2 && place + 1 < good.len() && (place - 2).is_multiple_of(4)
        };
        Self::by(reliable, |view| is_left_out(views[view].time_index))
    }

    fn by(views: &[usize], is_left_out: impl Fn(usize) -> bool) -> Self {
        let (left_out, train) = views.iter().partition(|view| is_left_out(**view));
        Self { train, left_out }
    }

    /// All of some views are fitted to.
    pub(super) fn whole(train: Vec<usize>) -> Self {
        Self { train, left_out: Vec::new() }
    }

    /// Views that judge: those left out, or all where none are.
    pub(super) fn judged(&self) -> &[usize] {
        if self.left_out.is_empty() { &self.train } else { &self.left_out }
    }
}

/// Times of views, which are in their order, each once.
pub(super) fn times_of(views: &[ObjectView], of: &[usize]) -> Vec<usize> {
    let mut times: Vec<usize> = of.iter().map(|view| views[*view].time_index).collect();
    times.dedup();
    times
}
