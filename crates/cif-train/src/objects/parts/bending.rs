//! What deforms where it stands, as it leaves the search for parts.

use cif_field::Gaussians;
use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::super::bend::Shifts;
use super::super::shape::Pose;

/// An object that deforms where it stands.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Bending {
    /// In the frame of the object.
    #[serde(skip)]
    pub(crate) gaussians: Gaussians,
    /// Shifts of its places in this frame.
    pub(crate) shifts: Shifts,
    /// Its frame, in the world.
    pub(crate) place: DVec3,
    /// Error on pixels left out.
    pub(crate) error: f64,
}

impl Bending {
    /// Its Gaussians in the world.
    pub(crate) fn placed(&self) -> Gaussians {
        let mut placed = self.gaussians.clone();
        Pose::at(self.place).carry(&mut placed);
        placed
    }

    /// Gradients, of a weight by metre, that pull displaced places of the object in the world to where they are at a time.
    pub(crate) fn pulled(
        &self,
        time: usize,
        canonical: &[[f32; 3]],
        displaced: &[[f32; 3]],
        weight: f64,
    ) -> Vec<[f32; 3]> {
        let own = |place: &[f32; 3]| DVec3::from_array(place.map(f64::from)) - self.place;
        let places: Vec<DVec3> = canonical.iter().map(own).collect();
        let shifted = self.shifts.shifted(time, &places);
        let pull = |(now, meant): (&[f32; 3], DVec3)| (weight * (own(now) - meant)).as_vec3().to_array();
        displaced.iter().zip(shifted).map(pull).collect()
    }
}
