//! Random numbers without state: every random choice draws from a stream named by the seed, its purpose and
//! a counter, so that a resumed run draws exactly what the uninterrupted one would have drawn.

use rand::SeedableRng;
use rand_pcg::Pcg64;

/// Purpose of random numbers, which names their stream.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    /// Order of the training views.
    Views = 1,
    /// Positions of split Gaussians.
    Split = 2,
    /// Draws and offsets of resampling.
    Resample = 3,
    /// Parameters of the deformation.
    Deformation = 4,
    /// Points inside travelling objects.
    Guidance = 5,
    /// Gaussians that stand still and are looked at again.
    Still = 7,
    /// Fits of objects.
    Objects = 8,
    /// Codes of heads.
    Codes = 9,
    /// Weights of the classifiers of heads.
    Classifier = 10,
    /// Their biases.
    ClassifierBiases = 11,
    /// Gaussians and pixels that losses of heads sample.
    HeadSamples = 12,
    /// Weights of the networks of heads.
    HeadNetwork = 13,
    /// Steps of heads.
    HeadSteps = 14,
    /// Changes of the set of Gaussians by heads.
    HeadRearrangements = 15,
    /// Cameras between views.
    HeadCameras = 16,
    /// Views that changes of the set of Gaussians are decided by.
    Contributions = 17,
}

/// The stream of a purpose; `counter` distinguishes its uses.
pub(crate) fn stream(seed: u64, purpose: Purpose, counter: u64) -> Pcg64 {
    Pcg64::seed_from_u64(derive(seed, purpose, counter))
}

/// A seed that depends on all three.
pub(crate) fn derive(seed: u64, purpose: Purpose, counter: u64) -> u64 {
    mix(mix(mix(seed) ^ purpose as u64) ^ counter)
}

/// SplitMix64 finaliser (Steele, Lea and Flood 2014).
fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
