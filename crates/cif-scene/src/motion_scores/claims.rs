//! Rotations by what nodes claim of them.

use cif_field::RotationEvidence;
use serde::Serialize;

/// True rotation above which an instance turns, degrees: smaller ones are within reach of [`RIGHT_DEG`] without turning.
const TURNS_DEG: f64 = 20.0;

/// Median error of a right rotation at most, degrees.
const RIGHT_DEG: f64 = 15.0;

/// Rotations of the rigid instances that turn by more than 20 degrees since the first time at which they were seen, by what
/// their nodes claim of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Claims {
    /// Claimed to be observed.
    pub observed: Verdicts,
    /// Claimed to be assumed.
    pub assumed: Verdicts,
    /// Without a claim.
    pub none: Verdicts,
}

/// Rotations that are right, of a median error of at most 15 degrees, and others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Verdicts {
    /// Instances whose rotation is right.
    pub right: usize,
    /// Instances whose rotation is wrong.
    pub wrong: usize,
}

impl Claims {
    /// Counts instances whose rotation was measured: how far they truly turn and by how much that is missed, degrees, and
    /// the claim.
    pub(super) fn of(instances: impl Iterator<Item = (f64, f64, Option<RotationEvidence>)>) -> Self {
        let mut claims = Self::default();
        for (_, error, claim) in instances.filter(|(turned, ..)| *turned > TURNS_DEG) {
            let verdicts = match claim {
                Some(RotationEvidence::Observed) => &mut claims.observed,
                Some(RotationEvidence::Assumed) => &mut claims.assumed,
                None => &mut claims.none,
            };
            if error <= RIGHT_DEG {
                verdicts.right += 1;
            } else {
                verdicts.wrong += 1;
            }
        }
        claims
    }
}
