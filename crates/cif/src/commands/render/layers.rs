//! `--what`: layers of a view.

use clap::ValueEnum;

/// Layers that can be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum)]
pub(super) enum What {
    /// Colour, 8-bit RGB
    Rgb,
    /// Colour with the paths of moving objects over it, fainter after the shown time, and the axes of rigid ones (x
    /// red, y green, z blue) where they are, 8-bit RGB
    Tracks,
    /// Mask id of the most probable instance, 16-bit grey, 0 = belongs to none
    Instance,
    /// The same in colours, dark where no instance is, 8-bit RGB
    InstanceColor,
    /// Expected depth along the viewing axis, 16-bit grey, millimetres for scenes in metres, 0 = none
    Depth,
    /// Depth in colours, 8-bit RGB
    DepthColor,
    /// Colour coverage, 16-bit grey, 65535 = 1
    Alpha,
    /// Probability that the pixel belongs to any instance, 16-bit grey, 65535 = 1
    Foreground,
    /// Instance coverage, 16-bit grey, 65535 = 1
    Coverage,
    /// Probability of the most probable instance, 16-bit grey, 65535 = 1
    Probability,
    /// Entropy of the instance distribution, 16-bit grey, thousandths of a nat
    Entropy,
}

impl What {
    /// Folder of the layer inside the output: its name, as it is typed.
    pub(super) fn folder(self) -> String {
        self.to_possible_value().map(|value| value.get_name().to_owned()).unwrap_or_default()
    }

    pub(super) fn of_instances(self) -> bool {
        matches!(
            self,
            Self::Instance
                | Self::InstanceColor
                | Self::Foreground
                | Self::Coverage
                | Self::Probability
                | Self::Entropy
        )
    }
}
