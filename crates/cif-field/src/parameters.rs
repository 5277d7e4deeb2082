//! The table of learnable tensors. Everything that only carries parameters (gradients, optimiser state, checks,
//! files, changes of the set of Gaussians, buffers on a GPU) loops over it.

/// Owner of the rows of a parameter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rows {
    /// A row per Gaussian.
    Gaussians,
    /// A row per entry of the identity rows.
    IdentityEntries,
    /// Rows of their own, which no change of the set of Gaussians touches.
    Fixed,
}

/// Activation that maps a raw parameter to the value that the scene is drawn with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// As it is.
    Identity,
    /// Exponential.
    Exponential,
    /// Logistic sigmoid.
    Sigmoid,
    /// Divided by its norm.
    UnitQuaternion,
}

/// Fate of the row of a Gaussian that relocation copies onto other ones.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OnCopy {
    /// The copies have it too.
    Same,
    /// It is divided among all of them, so that together they cover as much as before; the optimiser starts anew.
    Divided,
}

/// A learnable tensor of `[rows, width]` floats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parameter {
    /// Name in faults and messages, and with [`Self::part`] in `.cif` files.
    pub name: &'static str,
    /// Part of the field that holds it.
    pub part: &'static str,
    /// Name of its learning rate in settings, and of its optimiser state in saved runs.
    pub rate: &'static str,
    /// Owner of its rows.
    pub rows: Rows,
    /// Shape of a row; empty for one float.
    pub shape: &'static [usize],
    /// Activation of the raw values.
    pub activation: Activation,
    /// Its fate under relocation.
    pub on_copy: OnCopy,
}

impl Parameter {
    /// Floats per row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Name of its tensor in `.cif` files.
    #[must_use]
    pub fn file_name(&self) -> String {
        format!("{}.{}", self.part, self.name)
    }

    const fn gaussians(name: &'static str, rate: &'static str, shape: &'static [usize]) -> Self {
        Self {
            name,
            part: "gaussians",
            rate,
            rows: Rows::Gaussians,
            shape,
            activation: Activation::Identity,
            on_copy: OnCopy::Same,
        }
    }

    const fn fixed(name: &'static str) -> Self {
        Self { part: "deformation", rows: Rows::Fixed, ..Self::gaussians(name, name, &[]) }
    }
}

/// Centres.
pub const MEANS: Parameter = Parameter::gaussians("means", "means", &[3]);

/// Logarithms of standard deviations.
pub const LOG_SCALES: Parameter = Parameter {
    activation: Activation::Exponential,
    ..Parameter::gaussians("log_scales", "log_scales", &[3])
};

/// Raw rotations.
pub const QUATERNIONS: Parameter = Parameter {
    activation: Activation::UnitQuaternion,
    ..Parameter::gaussians("quaternions", "quaternions", &[4])
};

/// Opacities.
pub const OPACITY_LOGITS: Parameter = Parameter {
    activation: Activation::Sigmoid,
    on_copy: OnCopy::Divided,
    ..Parameter::gaussians("opacity_logits", "opacity", &[])
};

/// Occupancies.
pub const OCCUPANCY_LOGITS: Parameter = Parameter {
    activation: Activation::Sigmoid,
    on_copy: OnCopy::Divided,
    ..Parameter::gaussians("occupancy_logits", "occupancy", &[])
};

/// Spherical harmonics.
pub const SH_COEFFICIENTS: Parameter = Parameter::gaussians("sh_coefficients", "sh", &[16, 3]);

/// Hexplanes of the deformation.
pub const PLANES: Parameter = Parameter::fixed("planes");

/// Network of the deformation.
pub const MLP: Parameter = Parameter::fixed("mlp");

/// Calibrations of the identity rows.
pub const LOG_CALIBRATIONS: Parameter = Parameter {
    part: "identities",
    rows: Rows::IdentityEntries,
    ..Parameter::gaussians("log_calibrations", "calibration", &[])
};

/// Every learnable tensor, in the order of [`crate::Field::tensors`].
pub const TABLE: [Parameter; 9] = [
    MEANS,
    LOG_SCALES,
    QUATERNIONS,
    OPACITY_LOGITS,
    OCCUPANCY_LOGITS,
    SH_COEFFICIENTS,
    PLANES,
    MLP,
    LOG_CALIBRATIONS,
];

/// A parameter with its values.
pub type Tensor<'a> = (Parameter, &'a [f32]);

/// A parameter with its values, to be changed.
pub type TensorMut<'a> = (Parameter, &'a mut [f32]);

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::testing;

    #[test]
    fn fields_have_the_tensors_of_the_table_in_its_order() {
        let mut field = testing::field(7, 2);
        let listed: Vec<Parameter> = field.tensors().iter().map(|(parameter, _)| *parameter).collect();
        assert_eq!(listed, TABLE);
        let changed: Vec<Parameter> = field.tensors_mut().iter().map(|(parameter, _)| *parameter).collect();
        assert_eq!(changed, TABLE);
        for (parameter, values) in field.tensors() {
            let rows = match parameter.rows {
                Rows::Gaussians => 7,
                Rows::IdentityEntries => field.identities.as_ref().unwrap().labels.len(),
                Rows::Fixed => values.len(),
            };
            assert_eq!(values.len(), rows * parameter.width(), "{}", parameter.name);
        }
    }

    #[test]
    fn names_tell_parameters_apart() {
        for name in
            [|p: &Parameter| p.name.to_owned(), |p: &Parameter| p.rate.to_owned(), Parameter::file_name]
        {
            assert_eq!(TABLE.iter().map(name).collect::<BTreeSet<_>>().len(), TABLE.len());
        }
    }
}
