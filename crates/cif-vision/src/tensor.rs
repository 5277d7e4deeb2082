//! Arrays that go into models and come out of them.

/// An array with its shape, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    shape: Vec<usize>,
    values: Values,
}

/// Values of a [`Tensor`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Values {
    /// 32-bit floats.
    Floats(Vec<f32>),
    /// 64-bit integers; they fit tensors of other integers, truth values and floats too.
    Integers(Vec<i64>),
}

impl Tensor {
    /// An array of floats.
    ///
    /// # Panics
    /// When the shape does not fit the number of values.
    #[must_use]
    pub fn floats(shape: impl Into<Vec<usize>>, values: Vec<f32>) -> Self {
        Self::new(shape.into(), values.len(), Values::Floats(values))
    }

    /// An array of integers.
    ///
    /// # Panics
    /// When the shape does not fit the number of values.
    #[must_use]
    pub fn integers(shape: impl Into<Vec<usize>>, values: Vec<i64>) -> Self {
        Self::new(shape.into(), values.len(), Values::Integers(values))
    }

    fn new(shape: Vec<usize>, length: usize, values: Values) -> Self {
        assert_eq!(shape.iter().product::<usize>(), length, "{shape:?} is the shape of another array");
        Self { shape, values }
    }

    /// Lengths along the axes.
    #[must_use]
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The values, where they are floats.
    #[must_use]
    pub fn as_floats(&self) -> Option<&[f32]> {
        match &self.values {
            Values::Floats(values) => Some(values),
            Values::Integers(_) => None,
        }
    }

    #[cfg(feature = "onnx")]
    pub(crate) fn values(&self) -> &Values {
        &self.values
    }

    /// The same values with axes of length 1 before the others, or without some of those, so that there are `rank`.
    /// Exports differ in how many batches they count.
    #[must_use]
    pub(crate) fn with_rank(mut self, rank: usize) -> Self {
        while self.shape.len() > rank && self.shape[0] == 1 {
            self.shape.remove(0);
        }
        while self.shape.len() < rank {
            self.shape.insert(0, 1);
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_are_added_and_dropped() {
        let points = Tensor::floats([1, 2, 2], vec![0.0; 4]);
        assert_eq!(points.clone().with_rank(4).shape(), [1, 1, 2, 2]);
        assert_eq!(points.clone().with_rank(2).shape(), [2, 2]);
        assert_eq!(points.with_rank(1).shape(), [2, 2], "only axes of length 1 go");
    }
}
