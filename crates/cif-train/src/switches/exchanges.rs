//! Exchanges found by places: from one frame of a camera to the next, the mask of one object is where that of another
//! was, and the other way round. No two objects change places between two frames; trackers exchange them, and most
//! put it right a few frames later.

use std::collections::BTreeMap;

use super::masks::{Now, Sequence};
use super::usual::{TypicalColors, typical_colors};

/// Overlap of the mask of one object with that of another in the frame before from which they may be exchanged, and
/// below which a mask is not where it was.
const CROSSED: f64 = 0.3;
const LEFT: f64 = 0.1;

/// Largest share of the frames of a camera in which two objects may be exchanged; beyond, nobody knows which is which.
const MOST: f64 = 0.4;

/// By how much less like their objects masks may become when they are put back.
const WORSE: f64 = 0.05;

/// Puts back what is exchanged in less than half of the frames of a camera, unless colours show otherwise.
pub(super) fn put_back(sequences: &[Sequence], frames: &mut [Now<'_>]) {
    let typical = typical_colors(frames);
    for sequence in sequences {
        for ([a, b], cuts) in cuts(sequence, frames) {
            let exchanged = shorter(&cuts, sequence.len());
            if exchanged.len() as f64 > MOST * sequence.len() as f64 {
                continue;
            }
            let exchanged: Vec<usize> = exchanged.into_iter().map(|at| sequence.frames[at]).collect();
            let gains: Vec<f64> =
                exchanged.iter().filter_map(|frame| gain(&frames[*frame], [a, b], &typical)).collect();
            if gains.iter().sum::<f64>() < -WORSE * gains.len() as f64 {
                continue;
            }
            for frame in exchanged {
                let now = &mut frames[frame];
                let [of_a, of_b] = [a, b].map(|label| now.remove(&label));
                now.extend(of_a.map(|mask| (b, mask)));
                now.extend(of_b.map(|mask| (a, mask)));
            }
        }
    }
}

/// Places in a sequence at which the masks of two objects change places, by the labels of both.
fn cuts(sequence: &Sequence, frames: &[Now<'_>]) -> BTreeMap<[u16; 2], Vec<usize>> {
    let mut cuts: BTreeMap<[u16; 2], Vec<usize>> = BTreeMap::new();
    for at in 1..sequence.len() {
        if !sequence.follows(at) {
            continue;
        }
        let [before, now] = [at - 1, at].map(|at| &frames[sequence.frames[at]]);
        let in_both: Vec<u16> = now.keys().copied().filter(|label| before.contains_key(label)).collect();
        let overlap = |a: u16, b: u16| before[&a].place.overlap(&now[&b].place);
        for (k, &a) in in_both.iter().enumerate() {
            for &b in &in_both[k + 1..] {
                let crossed = overlap(a, b).min(overlap(b, a)) >= CROSSED;
                if crossed && overlap(a, a).max(overlap(b, b)) < LEFT {
                    cuts.entry([a, b]).or_default().push(at);
                }
            }
        }
    }
    cuts
}

/// Of a sequence that is cut into pieces, every other piece: those with fewer frames in all.
fn shorter(cuts: &[usize], length: usize) -> Vec<usize> {
    let (mut exchanged, mut straight) = (Vec::new(), Vec::new());
    for at in 0..length {
        let crossed = cuts.iter().filter(|cut| **cut <= at).count();
        if crossed % 2 == 1 { exchanged.push(at) } else { straight.push(at) }
    }
    if straight.len() < exchanged.len() { straight } else { exchanged }
}

/// By how much two masks of a frame become more like their objects when they are exchanged; `None` where they are not
/// both there, or the colours of the objects are not known.
fn gain(now: &Now<'_>, [a, b]: [u16; 2], typical: &BTreeMap<u16, TypicalColors>) -> Option<f64> {
    let masks = [now.get(&a)?, now.get(&b)?];
    let objects = [typical.get(&a)?, typical.get(&b)?];
    let exchanged = objects[0].likeness(&masks[1].colors) + objects[1].likeness(&masks[0].colors);
    Some(exchanged - objects[0].likeness(&masks[0].colors) - objects[1].likeness(&masks[1].colors))
}
