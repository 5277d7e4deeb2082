//! The two forms of what the invocations of a workgroup do together: through workgroup memory, which every device has,
//! and by subgroups. A module imports `workgroup`, pastes `lane_builtins` into the parameters of its entry points and
//! `lane` at their start; which form it gets is the device's. So are the walks over the splats of a tile: with a pixel per
//! invocation, whose sums go by subgroups, or with four, which is what software does best.

use super::snippet::Snippet;

/// Means by which the invocations of a workgroup cooperate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// Through workgroup memory.
    #[default]
    Portable,
    /// By subgroups.
    Subgroups,
}

impl Form {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Portable, Self::Subgroups];

    /// Snippets that modules import as `workgroup`, `lane_builtins`, `lane`, `tile_forward`, `tile_backward` and
    /// `partial_sums`.
    ///
    /// Subgroup built-ins are parameters and no members of a structure, for naga 30 misses those in HLSL; and it
    /// takes no `enable subgroups;`.
    #[must_use]
    pub fn snippets(self) -> &'static [Snippet; 6] {
        match self {
            Self::Portable => &[
                Snippet { name: "workgroup", text: || include_str!("shared/workgroup.wgsl").to_owned() },
                Snippet {
                    name: "lane_builtins",
                    text: || "@builtin(local_invocation_index) local: u32,".to_owned(),
                },
                Snippet { name: "lane", text: || "let lane = Lane(local);".to_owned() },
                Snippet {
                    name: "tile_forward",
                    text: || include_str!("shared/tile_forward.wgsl").to_owned(),
                },
                Snippet {
                    name: "tile_backward",
                    text: || include_str!("shared/tile_backward.wgsl").to_owned(),
                },
                Snippet {
                    name: "partial_sums",
                    text: || include_str!("shared/partial_sums.wgsl").to_owned(),
                },
            ],
            Self::Subgroups => &[
                Snippet {
                    name: "workgroup",
                    text: || include_str!("shared/workgroup_by_subgroups.wgsl").to_owned(),
                },
                Snippet {
                    name: "lane_builtins",
                    text: || {
                        "@builtin(local_invocation_index) local: u32,\n\
                         @builtin(subgroup_id) subgroup: u32,\n\
                         @builtin(num_subgroups) subgroups: u32,"
                            .to_owned()
                    },
                },
                Snippet {
                    name: "lane",
                    text: || {
                        "let lane = Lane(local, subgroup, subgroups, subgroupExclusiveAdd(1u));".to_owned()
                    },
                },
                Snippet {
                    name: "tile_forward",
                    text: || include_str!("shared/tile_forward_by_pixels.wgsl").to_owned(),
                },
                Snippet {
                    name: "tile_backward",
                    text: || include_str!("shared/tile_backward_by_pixels.wgsl").to_owned(),
                },
                Snippet {
                    name: "partial_sums",
                    text: || include_str!("shared/partial_sums_by_subgroups.wgsl").to_owned(),
                },
            ],
        }
    }
}

/// Fewest invocations of a subgroup that kernels can do with: the neighbours that `partial_sums_by_subgroups.wgsl` adds over.
pub const SMALLEST_SUBGROUP: u32 = 8;

/// Use of subgroups on a device, or the reason against it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SubgroupUse {
    /// It does, and known numbers came out right.
    Used,
    /// The adapter has none.
    Missing,
    /// `CIF_GPU_FEATURES` does not name them.
    HeldBack,
    /// Software stands in for a GPU, and loops over them.
    Software,
    /// They may have fewer invocations than [`SMALLEST_SUBGROUP`]: how many.
    Small(u32),
    /// Known numbers came out wrong: what did.
    Wrong(String),
}

impl std::fmt::Display for SubgroupUse {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Used => f.write_str("used for sums over workgroups, after known numbers came out right"),
            Self::Missing => f.write_str("not there, sums go through workgroup memory"),
            Self::HeldBack => f.write_str("not used, as CIF_GPU_FEATURES says"),
            Self::Software => f.write_str(
                "not used, because software loops over them (CIF_GPU_FEATURES=all uses them all the same)",
            ),
            Self::Small(size) => write!(
                f,
                "not used, because they may have {size} invocations, and kernels add over {SMALLEST_SUBGROUP} neighbours"
            ),
            Self::Wrong(what) => write!(f, "not used, because this driver does not get them right: {what}"),
        }
    }
}
