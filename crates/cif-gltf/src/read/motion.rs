//! Poses of nodes over time: keys of a chain of nodes, as rigid tracks.

use std::collections::BTreeMap;

use cif_scene::assemble::{Decomposed, Track, one_hemisphere};
use cif_scene::{PoseSample, VisibilitySample};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use gltf::json::animation::Interpolation;

use super::animation::{Curve, Curves, NodeCurves};
use super::hierarchy::{Local, is_hidden};
use super::source::Source;
use crate::conventions;

/// A node this much smaller than at its largest cannot be seen.
const HIDDEN_RATIO: f64 = 1e-3;
/// Most samples that a segment of a spline becomes.
const SPLINE_SAMPLES: f64 = 64.0;

/// Seconds to time codes.
pub(crate) struct Clock {
    first: f64,
    frames_per_second: f64,
    /// Time codes whose seconds were rounded when the file was written.
    known: BTreeMap<u32, f64>,
}

impl Clock {
    pub(crate) fn new(first: f64, frames_per_second: f64, known: impl Iterator<Item = f64>) -> Self {
        let seconds = |code| conventions::seconds(code, first, frames_per_second).to_bits();
        Self { first, frames_per_second, known: known.map(|code| (seconds(code), code)).collect() }
    }

    pub(crate) fn code(&self, seconds: f32) -> f64 {
        if let Some(code) = self.known.get(&seconds.to_bits()) {
            return *code;
        }
        let code = self.first + f64::from(seconds) * self.frames_per_second;
        // Single precision must not turn frame 7 into 7.0000002.
        if (code - code.round()).abs() < 1e-5 * code.abs().max(1.0) { code.round() } else { code }
    }

    pub(crate) fn seconds(&self, code: f64) -> f32 {
        conventions::seconds(code, self.first, self.frames_per_second)
    }
}

/// Nodes whose transforms follow each other, and what comes before them.
pub(crate) struct Chain {
    pub(crate) prefix: Option<DAffine3>,
    pub(crate) nodes: Vec<usize>,
    /// True when every key of a scale says something about visibility, as in our own files.
    pub(crate) ours: bool,
}

/// Motion of a chain: rigid track, stretch and visibility.
pub(crate) struct Movement {
    /// Its keys, and at rest the pose at the first moment at which the node can be seen.
    pub(crate) track: Track,
    /// To be worked into the splats.
    pub(crate) stretch: DMat3,
    pub(crate) visibility: Vec<VisibilitySample>,
    /// True when the stretch changes over time.
    pub(crate) stretch_changes: bool,
}

/// Everything that moves nodes.
pub(crate) struct Stage<'a> {
    pub(crate) source: &'a Source,
    pub(crate) locals: &'a [Local],
    pub(crate) curves: &'a Curves,
    pub(crate) clock: Clock,
    pub(crate) start: f64,
}

impl Stage<'_> {
    /// A chain without the nodes that change nothing.
    pub(crate) fn chain(&self, prefix: Option<DAffine3>, nodes: &[usize], ours: bool) -> Chain {
        let moves = |&&node: &&usize| {
            let still = matches!(
                self.locals[node],
                Local::Parts(DVec3::ZERO, rotation, DVec3::ONE) if rotation == DQuat::IDENTITY
            );
            !still || self.curves.of(node).is_some() || is_hidden(self.source, node)
        };
        Chain { prefix, nodes: nodes.iter().filter(moves).copied().collect(), ours }
    }

    /// Transform of a chain at a time; `None` where it has no inverse.
    pub(crate) fn at(&self, chain: &Chain, seconds: f32) -> Option<Decomposed> {
        let local = |node: usize| self.curves.local(node, &self.locals[node], seconds);
        match (chain.prefix, chain.nodes.as_slice()) {
            (None, []) => Decomposed::of(&DAffine3::IDENTITY),
            (None, &[node]) => match local(node) {
                // Nothing is computed, so that numbers come back as they were written.
                Local::Parts(translation, rotation, scale) if scale.cmpge(DVec3::ZERO).all() => {
                    Some(Decomposed { translation, rotation, stretch: DMat3::from_diagonal(scale) })
                }
                other => Decomposed::of(&other.affine()),
            },
            (prefix, nodes) => {
                let start = prefix.unwrap_or(DAffine3::IDENTITY);
                let product = nodes.iter().fold(start, |product, &node| product * local(node).affine());
                Decomposed::of(&product)
            }
        }
    }

    /// Follows a chain over all its keys; `None` where it never has an inverse.
    pub(crate) fn movement(&self, chain: &Chain) -> Option<Movement> {
        let curves: Vec<&NodeCurves> = chain.nodes.iter().filter_map(|&node| self.curves.of(node)).collect();
        let mut pose_times: Vec<f32> = Vec::new();
        let mut scale_times: Vec<f32> = Vec::new();
        for curves in &curves {
            for curve in [&curves.translation, &curves.rotation].into_iter().flatten() {
                self.add_times(curve, &mut pose_times);
            }
            if let Some(curve) = &curves.scale {
                self.add_times(curve, &mut scale_times);
            }
        }
        // Below a scaled parent, sizes move as well.
        if chain.nodes.len() > 1 {
            pose_times.extend_from_slice(&scale_times);
        }
        for times in [&mut pose_times, &mut scale_times] {
            times.sort_by(f32::total_cmp);
            times.dedup();
        }
        let start = self.clock.seconds(self.start);
        let decomposed = |times: &[f32]| -> Vec<(f32, Option<Decomposed>)> {
            times.iter().map(|&time| (time, self.at(chain, time))).collect()
        };
        let (poses, scales) = (decomposed(&pose_times), decomposed(&scale_times));
        let rest = (start, self.at(chain, start));
        let size = |decomposed: &Option<Decomposed>| decomposed.map_or(0.0, |d| d.size());
        let sizes = poses.iter().chain(&scales).chain([&rest]).map(|(_, d)| size(d));
        let largest = sizes.fold(0.0, f64::max);
        if largest == 0.0 {
            return None;
        }
        let always_hidden = chain.ours && largest <= 10.0 * f64::from(conventions::HIDDEN_SCALE);
        let visible = |d: &Option<Decomposed>| !always_hidden && size(d) > HIDDEN_RATIO * largest;
        let all = || poses.iter().chain(&scales);
        let shown = [&rest].into_iter().chain(all()).find(|(_, d)| size(d) > HIDDEN_RATIO * largest);
        let (_, first) = shown?;
        let first = (*first)?;
        let mut stretch = first.stretch;
        if always_hidden {
            stretch *= largest.recip();
        }
        let stretch_changes = all().filter(|(_, d)| visible(d)).filter_map(|(_, d)| *d).any(|d| {
            let change = d.stretch - first.stretch;
            change.to_cols_array().iter().any(|value| value.abs() > 1e-3 * largest)
        });
        let keys = poses.iter().filter_map(|(time, pose)| Some((*pose)?.pose(self.clock.code(*time))));
        let mut keys: Vec<PoseSample> = keys.collect();
        one_hemisphere(&mut keys);
        // What hides nodes besides their size.
        let shown = |seconds: f32| {
            chain.nodes.iter().all(|&node| {
                let steps = self.curves.of(node).and_then(|curves| curves.visibility.as_ref());
                steps.map_or_else(|| !is_hidden(self.source, node), |steps| steps.at(seconds))
            })
        };
        let mut steps: Vec<f32> = curves
            .iter()
            .filter_map(|curves| curves.visibility.as_ref())
            .flat_map(|steps| steps.times.clone())
            .collect();
        let is_stepped = !steps.is_empty();
        steps.extend(&scale_times);
        steps.sort_by(f32::total_cmp);
        steps.dedup();
        let is_sized = |seconds: f32| scale_times.is_empty() || visible(&self.at(chain, seconds));
        let mut visibility: Vec<VisibilitySample> = steps
            .iter()
            .map(|&time| VisibilitySample {
                time_code: self.clock.code(time),
                visible: is_sized(time) && shown(time),
            })
            .collect();
        if !chain.ours {
            visibility.dedup_by_key(|sample| sample.visible);
            if visibility.iter().all(|sample| sample.visible) {
                visibility.clear();
            }
        }
        let hidden = !is_stepped && !shown(start);
        if hidden || (always_hidden && visibility.is_empty()) {
            visibility = vec![VisibilitySample { time_code: self.start, visible: false }];
        }
        let track = Track { rest: first.pose(self.start), samples: keys };
        Some(Movement { track, stretch, visibility, stretch_changes })
    }

    /// Key times of a curve, so close that straight lines between them follow it.
    fn add_times(&self, curve: &Curve, times: &mut Vec<f32>) {
        times.extend_from_slice(&curve.times);
        for pair in curve.times.windows(2) {
            let length = pair[1] - pair[0];
            match curve.interpolation {
                Interpolation::Linear => {}
                // Held until just before the next key. A stepped scale only hides.
                Interpolation::Step => {
                    let before = (pair[1] - 1e-3 * length).min(pair[1].next_down());
                    if before > pair[0] && !curve.hides() {
                        times.push(before);
                    }
                }
                Interpolation::CubicSpline => {
                    let frames = f64::from(length) * self.clock.frames_per_second;
                    let count = frames.ceil().clamp(1.0, SPLINE_SAMPLES) as u16;
                    times.extend((1..count).map(|k| pair[0] + length * f32::from(k) / f32::from(count)));
                }
            }
        }
    }
}
