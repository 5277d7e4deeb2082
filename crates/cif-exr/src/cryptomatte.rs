//! Which objects cover a pixel, and how much: ranks of a Cryptomatte out of instance probabilities.
//!
//! A pixel's foreground, the share of what it shows that belongs to any instance, is divided among the instances as
//! their rendered probabilities M are. The rest of the covered pixel is the object `background`, so that the
//! coverages add up to alpha, as those of a renderer of surfaces do.

use std::collections::BTreeMap;
use std::ops::Range;

use cif_dataset::cryptomatte::{BACKGROUND, id_as_float, object_id};
use cif_geometry::PixelGrid;
use cif_render::{InstanceImage, InstanceRanks};

use crate::{ExrError, Object};

/// Name of the layer.
pub const LAYER: &str = "uCryptoObject";

/// Objects per pixel; two per group of four channels.
pub const RANKS: usize = 6;

/// The manifest: names with their ids in hexadecimal, the background last.
///
/// # Errors
/// When two names have the same id.
pub fn manifest(objects: &[Object]) -> Result<String, ExrError> {
    let mut seen: BTreeMap<u32, &str> = BTreeMap::new();
    let mut entries = Vec::with_capacity(objects.len() + 1);
    for name in objects.iter().map(|object| object.name.as_str()).chain([BACKGROUND]) {
        let id = object_id(name);
        if let Some(first) = seen.insert(id, name) {
            return Err(ExrError::SameId { first: first.to_owned(), second: name.to_owned() });
        }
        entries.push(format!("{}:\"{id:08x}\"", serde_json::Value::from(name)));
    }
    Ok(format!("{{{}}}", entries.join(",")))
}

/// Ids (bits of a 32-bit integer) and coverages of some pixels, most coverage first, [`RANKS`] of them.
#[must_use]
pub fn planes(
    objects: &[Object],
    alpha: &PixelGrid<f32>,
    instances: &InstanceImage,
    ranks: &InstanceRanks,
    pixels: Range<usize>,
) -> Vec<(Vec<f32>, Vec<f32>)> {
    let ids: Vec<f32> = objects.iter().map(|object| id_as_float(object_id(&object.name))).collect();
    let background = id_as_float(object_id(BACKGROUND));
    let mut planes = vec![(vec![0.0; pixels.len()], vec![0.0; pixels.len()]); RANKS];
    let mut found: Vec<(f32, f32)> = Vec::new();
    for (place, pixel) in pixels.enumerate() {
        found.clear();
        let whole = instances.coverage.pixels[pixel];
        let covered = alpha.pixels[pixel].clamp(0.0, 1.0);
        // Nothing is divided where no instance has any probability.
        let foreground =
            if whole > 0.0 { instances.foreground.pixels[pixel].clamp(0.0, covered) } else { 0.0 };
        for (labels, probabilities) in &ranks.ranks {
            let coverage = foreground * probabilities.pixels[pixel] / whole;
            if let Some(id) = ids.get(usize::from(labels.pixels[pixel]).wrapping_sub(1))
                && coverage > 0.0
            {
                found.push((*id, coverage));
            }
        }
        if covered > foreground {
            found.push((background, covered - foreground));
        }
        // Stable: instances come before the background where both cover the same.
        found.sort_by(|a, b| b.1.total_cmp(&a.1));
        for ((id_plane, coverage_plane), (id, coverage)) in planes.iter_mut().zip(&found) {
            (id_plane[place], coverage_plane[place]) = (*id, *coverage);
        }
    }
    planes
}
