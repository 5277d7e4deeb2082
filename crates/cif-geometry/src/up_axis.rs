//! The axis of a world that points up.

use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Which world axis points up. The data is not turned: the axis is only declared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpAxis {
    /// +y.
    Y,
    /// +z.
    #[default]
    Z,
}

impl FromStr for UpAxis {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "y" | "Y" => Ok(Self::Y),
            "z" | "Z" => Ok(Self::Z),
            _ => Err("y or z is expected".to_owned()),
        }
    }
}
