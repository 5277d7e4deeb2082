//! Splats, and the instances that they may belong to.

use cif_geometry::spherical_harmonics::{BAND_0, coefficient_count};

/// Splats in post-activation form; every array has one entry per splat.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Splats {
    /// Centres, local frame.
    pub means: Vec<[f32; 3]>,
    /// Unit quaternions (w, x, y, z).
    pub orientations: Vec<[f32; 4]>,
    /// Standard deviations along the axes, world units; 0 along an axis in which a splat is flat.
    pub scales: Vec<[f32; 3]>,
    /// Opacities in [0, 1].
    pub opacities: Vec<f32>,
    /// Spherical-harmonics degree, 0 to 3.
    pub sh_degree: u8,
    /// Coefficients `[N, (degree + 1)^2, 3]`, splat-major, DC first, RGB inner; raw (colour = 0.5 + 0.28209 c0).
    pub sh_coefficients: Vec<f32>,
    /// Occupancies in [0, 1].
    pub occupancies: Vec<f32>,
    /// Probability of the most probable instance; 0 without identities.
    pub identity_probabilities: Vec<f32>,
    /// The instances that every splat may belong to, most probable first; empty without identities.
    pub identities: Vec<IdentityShares>,
    /// Row of every splat in the field; [`Splats::NO_ROW`] for a splat that comes from elsewhere.
    pub rows: Vec<u32>,
}

/// Most instances that are kept of the identity row of a splat.
pub const SHARES_PER_SPLAT: usize = 4;

/// The most probable instances of a splat, with unused places at the end.
pub type IdentityShares = [IdentityShare; SHARES_PER_SPLAT];

/// An instance that a splat may belong to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IdentityShare {
    /// Mask value of the instance; 0 for an unused place.
    pub id: u16,
    /// Probability of the instance times the share of the splat's image that was labelled at all: what is missing to
    /// 1 over all instances was seen outside of every mask.
    pub share: f32,
}

/// Fills coefficients of many splats up from one degree to a higher one.
pub(crate) fn raise_degree(coefficients: &mut Vec<f32>, from: u8, to: u8) {
    if from == to {
        return;
    }
    let (from, to) = (3 * coefficient_count(from), 3 * coefficient_count(to));
    let mut raised = Vec::with_capacity(coefficients.len() / from * to);
    for row in coefficients.chunks_exact(from) {
        raised.extend_from_slice(row);
        raised.resize(raised.len() + to - from, 0.0);
    }
    *coefficients = raised;
}

impl Splats {
    /// Entry of [`Splats::rows`] for a splat that is no row of a field.
    pub const NO_ROW: u32 = u32::MAX;

    /// Number of splats.
    #[must_use]
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Adds splats; the higher degree of the two is kept, the other is filled up with zeros, and so are identities
    /// that only one of them has.
    pub fn append(&mut self, mut more: Self) {
        if self.is_empty() {
            *self = more;
            return;
        }
        let degree = self.sh_degree.max(more.sh_degree);
        self.raise_degree(degree);
        more.raise_degree(degree);
        if !(self.identities.is_empty() && more.identities.is_empty()) {
            self.identities.resize(self.len(), IdentityShares::default());
            more.identities.resize(more.len(), IdentityShares::default());
            self.identities.append(&mut more.identities);
        }
        self.means.append(&mut more.means);
        self.orientations.append(&mut more.orientations);
        self.scales.append(&mut more.scales);
        self.opacities.append(&mut more.opacities);
        self.sh_coefficients.append(&mut more.sh_coefficients);
        self.occupancies.append(&mut more.occupancies);
        self.identity_probabilities.append(&mut more.identity_probabilities);
        self.rows.append(&mut more.rows);
    }

    /// Fills the coefficients up to a degree that is no lower than theirs.
    pub(crate) fn raise_degree(&mut self, degree: u8) {
        raise_degree(&mut self.sh_coefficients, self.sh_degree, degree);
        self.sh_degree = degree;
    }

    /// Opacity-weighted mean of the occupancies; 0 where all splats are clear.
    #[must_use]
    pub fn mean_occupancy(&self) -> f32 {
        let pairs = self.occupancies.iter().zip(&self.opacities);
        let (sum, total) = pairs.fold((0.0, 0.0), |(sum, total), (occupancy, opacity)| {
            (sum + f64::from(occupancy * opacity), total + f64::from(*opacity))
        });
        if total > 0.0 { (sum / total) as f32 } else { 0.0 }
    }

    /// View-independent colours `clamp(0.5 + 0.28209 c0)`, display-referred.
    #[must_use]
    pub fn base_colors(&self) -> Vec<[f32; 3]> {
        let stride = 3 * coefficient_count(self.sh_degree);
        let band_0 = BAND_0 as f32;
        self.sh_coefficients
            .chunks_exact(stride)
            .map(|sh| std::array::from_fn(|c| (0.5 + band_0 * sh[c]).clamp(0.0, 1.0)))
            .collect()
    }
}
