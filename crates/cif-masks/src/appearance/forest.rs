//! Classes of similar pixels: a forest of randomised trees over samples of keyframes.
//!
//! The leaf that a pixel falls into holds the samples that are near it in the features that separate classes there, so
//! that a forest is a fast stand-in for the nearest neighbours of a kd-tree, with a metric learnt from the keyframes.
//! Source: Geurts, Ernst, Wehenkel, "Extremely randomized trees", Machine Learning 63, 2006.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use rayon::prelude::*;

use super::Features;
use super::features::DIMENSIONS;

/// Trees of a forest.
const TREES: usize = 12;

/// Pixels of a keyframe that stand for a class at most.
const SAMPLES: usize = 2000;

/// As many times more stand for what is unlabelled, which is more diverse.
const UNLABELLED_FACTOR: usize = 8;

/// Nodes with fewer samples are leaves.
const LEAF: usize = 8;

/// Random splits that a node chooses from.
const TRIES: usize = 6;

/// Samples that splits are judged by, evenly spread over those of the node.
const JUDGES: usize = 4096;

/// Trees that are asked first: where they all but agree, the others are not asked.
const ASKED_FIRST: usize = 4;

/// Share that the first trees have to give to one class to agree.
const AGREEMENT: f32 = 0.999;

/// Pixels that walk through a tree together.
const LANES: usize = 8;

/// Pixels of keyframes with their classes.
#[derive(Clone, Default)]
pub(crate) struct Samples {
    points: Vec<[f32; DIMENSIONS]>,
    classes: Vec<u16>,
}

impl Samples {
    /// Takes pixels of every class, evenly spread over those that it has. Pixels for which `class_of` has none are
    /// left out.
    pub(crate) fn new(features: &Features, classes: usize, class_of: impl Fn(usize) -> Option<u16>) -> Self {
        let mut pixels = vec![Vec::new(); classes];
        for pixel in 0..features.values.len() {
            if let Some(class) = class_of(pixel) {
                pixels[usize::from(class)].push(pixel);
            }
        }
        let mut samples = Self::default();
        for (class, pixels) in pixels.iter().enumerate() {
            let drawn = (if class == 0 { UNLABELLED_FACTOR * SAMPLES } else { SAMPLES }).min(pixels.len());
            for k in 0..drawn {
                samples.points.push(features.values[pixels[k * pixels.len() / drawn]]);
                samples.classes.push(class as u16);
            }
        }
        samples
    }

    /// Adds the samples of another keyframe.
    pub(crate) fn extend(&mut self, other: &Self) {
        self.points.extend_from_slice(&other.points);
        self.classes.extend_from_slice(&other.classes);
    }
}

/// A node of a tree.
#[derive(Clone, Copy, Debug)]
struct Node {
    /// Values below go to the first child, others to the second.
    threshold: f32,
    /// Feature that decides, or `DIMENSIONS` in leaves, times [`PLACES`]; plus the index of the first child, behind
    /// which the second lies, or in leaves the index of the leaf.
    feature_and_next: u32,
}

/// Nodes that a tree may have.
const PLACES: u32 = 1 << 28;

impl Node {
    fn leaf(leaf: usize) -> Self {
        Self { threshold: 0.0, feature_and_next: DIMENSIONS as u32 * PLACES + leaf as u32 }
    }

    fn branch(feature: usize, threshold: f32, next: usize) -> Self {
        Self { threshold, feature_and_next: feature as u32 * PLACES + next as u32 }
    }
}

/// A tree: nodes from the root on, and per leaf the classes of its samples with their shares.
struct Tree {
    nodes: Vec<Node>,
    /// Where the shares of each leaf begin; one more for the end.
    leaves: Vec<u32>,
    shares: Vec<(u16, f32)>,
}

/// Trees over the samples of keyframes.
pub(crate) struct Forest {
    trees: Vec<Tree>,
    classes: usize,
}

impl Forest {
    /// Grows the trees; each has a seed of its own.
    pub(crate) fn new(samples: &Samples, classes: usize) -> Self {
        let grow = |seed: usize| Tree::grow(samples, classes, &mut Pcg64::seed_from_u64(seed as u64));
        Self { trees: (0..TREES).into_par_iter().map(grow).collect(), classes }
    }

    /// Probability of every class at every pixel, `[pixels][classes]`, in units of 1 / 255.
    pub(crate) fn classify(&self, features: &Features) -> Vec<u8> {
        /// Pixels that pass a tree together, while it is in the cache.
        const TOGETHER: usize = 1024;
        let mut found = Vec::with_capacity(features.values.len() * self.classes);
        let mut sums = vec![0.0_f32; TOGETHER * self.classes];
        for values in features.values.chunks(TOGETHER) {
            sums.fill(0.0);
            let mut asked = [TREES; TOGETHER];
            // Pixels that the next tree is asked about.
            let mut open: Vec<usize> = (0..values.len()).collect();
            for (k, tree) in self.trees.iter().enumerate() {
                for pixels in open.chunks(LANES) {
                    let leaves = tree.leaves_of(values, pixels);
                    for (pixel, leaf) in pixels.iter().zip(leaves) {
                        let sums = &mut sums[pixel * self.classes..(pixel + 1) * self.classes];
                        for (class, share) in tree.shares_of(leaf) {
                            sums[usize::from(*class)] += share;
                        }
                    }
                }
                if k + 1 == ASKED_FIRST {
                    open.retain(|pixel| {
                        let sums = &sums[pixel * self.classes..(pixel + 1) * self.classes];
                        let agreed = sums.iter().any(|sum| *sum >= AGREEMENT * ASKED_FIRST as f32);
                        if agreed {
                            asked[*pixel] = ASKED_FIRST;
                        }
                        !agreed
                    });
                }
            }
            for (sums, asked) in sums.chunks_exact(self.classes).zip(asked).take(values.len()) {
                found.extend(sums.iter().map(|sum| (sum * (255.0 / asked as f32) + 0.5) as u8));
            }
        }
        found
    }
}

impl Tree {
    /// Leaves that pixels fall into, at most [`LANES`]: walks wait for memory at every node, so that several go on
    /// together. Lanes beyond the pixels repeat the first.
    fn leaves_of(&self, values: &[[f32; DIMENSIONS]], pixels: &[usize]) -> [usize; LANES] {
        let values: [&[f32; DIMENSIONS]; LANES] =
            std::array::from_fn(|lane| &values[pixels.get(lane).copied().unwrap_or(pixels[0])]);
        let mut nodes = [self.nodes[0]; LANES];
        loop {
            let mut walking = false;
            for (node, value) in nodes.iter_mut().zip(values) {
                if let Some(feature) = value.get((node.feature_and_next / PLACES) as usize) {
                    let next = (node.feature_and_next % PLACES) as usize;
                    *node = self.nodes[next + usize::from(*feature >= node.threshold)];
                    walking = true;
                }
            }
            if !walking {
                return nodes.map(|node| (node.feature_and_next % PLACES) as usize);
            }
        }
    }

    /// Classes of the samples of a leaf with their shares.
    fn shares_of(&self, leaf: usize) -> &[(u16, f32)] {
        &self.shares[self.leaves[leaf] as usize..self.leaves[leaf + 1] as usize]
    }

    fn grow(samples: &Samples, classes: usize, random: &mut Pcg64) -> Self {
        let mut tree = Self { nodes: vec![Node::leaf(0)], leaves: vec![0], shares: Vec::new() };
        let mut open: Vec<(usize, Vec<u32>)> = vec![(0, (0..samples.points.len() as u32).collect())];
        while let Some((at, rows)) = open.pop() {
            let Some((feature, threshold)) = split(samples, classes, &rows, random) else {
                tree.nodes[at] = Node::leaf(tree.leaves.len() - 1);
                tree.shares.extend(shares(samples, &rows));
                tree.leaves.push(tree.shares.len() as u32);
                continue;
            };
            let next = tree.nodes.len();
            tree.nodes.extend([Node::leaf(0); 2]);
            tree.nodes[at] = Node::branch(feature, threshold, next);
            let (low, high) =
                rows.iter().partition(|row| samples.points[**row as usize][feature] < threshold);
            open.extend([(next, low), (next + 1, high)]);
        }
        tree
    }
}

/// Classes of samples with their shares.
fn shares(samples: &Samples, rows: &[u32]) -> Vec<(u16, f32)> {
    let mut classes: Vec<u16> = rows.iter().map(|row| samples.classes[*row as usize]).collect();
    classes.sort_unstable();
    let share = |run: &[u16]| (run[0], run.len() as f32 / rows.len() as f32);
    classes.chunk_by(|a, b| a == b).map(share).collect()
}

/// The random split with the purest halves; `None` for a leaf.
fn split(samples: &Samples, classes: usize, rows: &[u32], random: &mut Pcg64) -> Option<(usize, f32)> {
    let class_of = |row: &u32| samples.classes[*row as usize];
    if rows.len() < LEAF || rows.iter().all(|row| class_of(row) == class_of(&rows[0])) {
        return None;
    }
    let judges: Vec<u32> = rows.iter().step_by(rows.len().div_ceil(JUDGES)).copied().collect();
    let mut best = None;
    let mut purest = 0.0;
    let mut counts = vec![[0.0_f32; 2]; classes];
    for _ in 0..TRIES {
        let feature = random.random_range(0..DIMENSIONS);
        let place: f32 = random.random_range(0.02..0.98);
        let values = || judges.iter().map(|row| samples.points[*row as usize][feature]);
        let (low, high) = values().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(v), high.max(v)));
        let threshold = low + (high - low) * place;
        counts.fill([0.0; 2]);
        let mut sizes = [0.0_f32; 2];
        for (row, value) in judges.iter().zip(values()) {
            let side = usize::from(value >= threshold);
            counts[usize::from(class_of(row))][side] += 1.0;
            sizes[side] += 1.0;
        }
        if sizes.contains(&0.0) {
            continue;
        }
        // Sum over the halves of size times (1 - Gini impurity).
        let purity: f32 = counts.iter().map(|n| n[0] * n[0] / sizes[0] + n[1] * n[1] / sizes[1]).sum();
        if purity > purest {
            (best, purest) = (Some((feature, threshold)), purity);
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn features(values: impl Iterator<Item = f32>) -> Features {
        Features { values: values.map(|v| std::array::from_fn(|d| v * (d as f32 + 1.0))).collect() }
    }

    #[test]
    fn pixels_like_those_of_a_class_belong_to_it() {
        let seen = features((0..3000).map(|k| (k % 3) as f32 * 20.0 + (k % 7) as f32));
        let samples = Samples::new(&seen, 3, |pixel| Some((pixel % 3) as u16));
        let forest = Forest::new(&samples, 3);
        let found = forest.classify(&features([3.0, 23.0, 43.0].into_iter()));
        for class in 0..3 {
            assert!(found[class * 3 + class] > 240, "{found:?}");
        }
    }

    #[test]
    fn equal_pixels_of_two_classes_are_shared() {
        let samples = Samples::new(&features([5.0; 100].into_iter()), 2, |pixel| Some((pixel % 2) as u16));
        let found = Forest::new(&samples, 2).classify(&features([5.0, 90.0].into_iter()));
        assert_eq!(found, [128, 128, 128, 128]);
    }

    #[test]
    fn pixels_without_a_class_are_no_samples() {
        let samples = Samples::new(&features([5.0; 10].into_iter()), 2, |pixel| (pixel < 4).then_some(1));
        assert_eq!(samples.classes, [1; 4]);
    }
}
