//! Options of an export for the program that opens it.

use cif_scene::UpAxis;
use cif_scene::format::Ground;
use clap::ValueEnum;
use clap::builder::PossibleValue;

/// Program that opens an export.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Preset {
    Mujoco,
    Newton,
    Isaac,
    Blender,
    Web,
}

/// Options that a preset sets, each as its flag would; `None` leaves the default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Preferred {
    pub(super) ground: Option<Ground>,
    pub(super) weld_kinematic: Option<bool>,
    pub(super) bake_blur: Option<bool>,
    pub(super) hulls: Option<u16>,
    pub(super) proxy_points: Option<usize>,
    pub(super) ply_up: Option<UpAxis>,
}

impl Preset {
    /// Options for this program.
    pub(super) fn preferred(self) -> Preferred {
        let none = Preferred::default();
        match self {
            // It makes a body that falls of every kinematic one.
            Self::Mujoco => Preferred {
                ground: Some(Ground::Auto),
                weld_kinematic: Some(true),
                proxy_points: Some(0),
                ..none
            },
            Self::Newton | Self::Isaac => {
                Preferred { ground: Some(Ground::Auto), proxy_points: Some(0), ..none }
            }
            // It draws splats without a filter.
            Self::Blender => Preferred { bake_blur: Some(true), ..none },
            Self::Web => Preferred { hulls: Some(0), proxy_points: Some(0), ply_up: Some(UpAxis::Y), ..none },
        }
    }

    /// Its flags, as they would be typed.
    pub(super) fn flags(self) -> String {
        let Preferred { ground, weld_kinematic, bake_blur, hulls, proxy_points, ply_up } = self.preferred();
        let ground = ground.map(|ground| match ground {
            Ground::None => "--ground none".to_owned(),
            Ground::Auto => "--ground auto".to_owned(),
            Ground::At(height) => format!("--ground {height}"),
        });
        let switch = |name: &str, value: Option<bool>| {
            value.map(|on| if on { format!("--{name}") } else { format!("--{name}=false") })
        };
        let up = ply_up.map(|up| match up {
            UpAxis::Y => "--ply-up y",
            UpAxis::Z => "--ply-up z",
        });
        let all = [
            ground,
            switch("weld-kinematic", weld_kinematic),
            switch("bake-blur", bake_blur),
            hulls.map(|hulls| format!("--hulls {hulls}")),
            proxy_points.map(|points| format!("--proxy-points {points}")),
            up.map(str::to_owned),
        ];
        all.into_iter().flatten().collect::<Vec<_>>().join(" ")
    }

    /// Its name on the command line.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Mujoco => "mujoco",
            Self::Newton => "newton",
            Self::Isaac => "isaac",
            Self::Blender => "blender",
            Self::Web => "web",
        }
    }
}

impl ValueEnum for Preset {
    fn value_variants<'a>() -> &'a [Self] {
        &[Self::Mujoco, Self::Newton, Self::Isaac, Self::Blender, Self::Web]
    }

    fn to_possible_value(&self) -> Option<PossibleValue> {
        Some(PossibleValue::new(self.name()).help(self.flags()))
    }
}
