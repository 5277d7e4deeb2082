//! Names of extensions and attributes, and what they can hold.

use cif_scene::MotionModel;

/// The extension that holds the splats.
pub const EXTENSION: &str = "KHR_gaussian_splatting";
/// The extension by which a node is hidden.
pub const VISIBILITY: &str = "KHR_node_visibility";
/// The extension by which animations show and hide nodes.
pub const POINTER: &str = "KHR_animation_pointer";
/// Most expensive motion that a file can hold: build graphs for glTF with no more than this. Some splats
/// ([`cif_scene::LOOSE_SPLATS`]) may have paths of their own nevertheless.
pub const MOST_EXPENSIVE_MOTION: MotionModel = MotionModel::Parts;
/// Attribute with the row of every splat in the field: two unsigned shorts, the low one first.
pub const ROW: &str = "_CIF_ROW";
/// Attribute with the occupancy of every splat.
pub const OCCUPANCY: &str = "_CIF_OCCUPANCY";
/// Attribute with the probability of the most probable instance of every splat.
pub const IDENTITY: &str = "_CIF_IDENTITY";
/// Attribute of the instances that every splat may belong to, as ids, most probable first; 0 for an unused place.
pub const INSTANCE_IDS: &str = "_CIF_INSTANCE_IDS";
/// Attribute next to [`INSTANCE_IDS`]: probability of each instance times the share of the splat's image that was
/// labelled.
pub const INSTANCE_SHARES: &str = "_CIF_INSTANCE_SHARES";

/// Value of `asset.generator`.
pub(crate) const GENERATOR: &str = concat!("cif ", env!("CARGO_PKG_VERSION"));
/// Beginning of it, whatever the version.
pub(crate) const GENERATOR_PREFIX: &str = "cif ";
