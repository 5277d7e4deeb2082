//! Appearance of objects as directions that models of pictures and texts share, for questions in words.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// Most numbers of a direction that is believed.
const MAX_LENGTH: usize = 1 << 16;
/// Largest distance of the length of a direction from 1: of 16-bit floats it is less.
const TOLERANCE: f64 = 1e-2;

/// Appearance of one object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Embedding {
    /// Name of the model; texts have to be embedded by the same.
    pub model: String,
    /// Vector of length 1.
    pub direction: Vec<f32>,
}

/// Appearance of the instances of a field, all by one model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Embeddings {
    /// Name of the model.
    pub model: String,
    /// Vectors of length 1 by the id of the instance; instances that no view shows have none.
    pub of: BTreeMap<u16, Vec<f32>>,
}

impl Embedding {
    /// True where there is a direction.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        is_direction(&self.direction)
    }
}

impl Embeddings {
    /// That of an instance.
    #[must_use]
    pub fn embedding(&self, id: u16) -> Option<Embedding> {
        let direction = self.of.get(&id)?.clone();
        Some(Embedding { model: self.model.clone(), direction })
    }

    /// True where all are directions.
    #[must_use]
    pub fn is_valid(&self) -> bool {
        self.of.values().all(|direction| is_direction(direction))
    }
}

fn is_direction(vector: &[f32]) -> bool {
    let length = vector.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt();
    vector.len() <= MAX_LENGTH && (length - 1.0).abs() < TOLERANCE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_directions_are_embeddings() {
        let of = |direction: &[f32]| Embedding { model: "m".to_owned(), direction: direction.to_vec() };
        assert!(of(&[0.6, -0.8]).is_valid());
        for wrong in [&[][..], &[0.0, 0.0], &[1.0, 1.0], &[f32::NAN, 1.0], &[f32::INFINITY]] {
            assert!(!of(wrong).is_valid(), "{wrong:?}");
        }
        let all = Embeddings { model: "m".to_owned(), of: [(3, vec![0.6, -0.8])].into() };
        assert_eq!(all.embedding(3), Some(of(&[0.6, -0.8])));
        assert_eq!(all.embedding(4), None);
    }
}
