//! Cryptomatte: several objects per pixel with their coverage, in EXR files that compositors pick objects from.
//!
//! Source: Friedman and Jones, "Cryptomatte specification", version 1.2.0. A layer `L` keeps, in the 32-bit float
//! channels of `L00`, `L01`, ..., pairs of an object's id and its coverage, most coverage first; an id is the
//! hash of the object's name, and the header names all objects in a manifest.
//!
//! | module | answers |
//! |---|---|
//! | `read` | what is in a file |
//! | `objects` | which instance an object is |

mod objects;
mod read;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use cif_geometry::PixelGrid;

pub use objects::{BACKGROUND, ObjectIds};
pub(crate) use objects::{assign, explicit};
pub use read::{Header, read, read_header};

/// Name of the hash of [`object_id`] in the header of a Cryptomatte.
pub const HASH: &str = "MurmurHash3_32";

/// Name of the conversion of [`id_as_float`] in the header of a Cryptomatte.
pub const CONVERSION: &str = "uint32_to_float32";

/// Id of an object: MurmurHash3 (x86, 32 bits, seed 0) of its UTF-8 name, with the lowest bit of the exponent
/// flipped where the bits would otherwise be a float that is zero, denormal, infinite or not a number.
#[must_use]
pub fn object_id(name: &str) -> u32 {
    let hash = murmur(name);
    let exponent = hash >> 23 & 255;
    if exponent == 0 || exponent == 255 { hash ^ 1 << 23 } else { hash }
}

/// Key of a layer in the header: the first seven digits of the hash of its name.
#[must_use]
pub fn layer_key(layer: &str) -> String {
    format!("{:08x}", murmur(layer))[..7].to_owned()
}

/// The id as channels hold it: the same bits.
#[must_use]
pub fn id_as_float(id: u32) -> f32 {
    f32::from_bits(id)
}

fn murmur(text: &str) -> u32 {
    murmur3::murmur3_32(&mut text.as_bytes(), 0).expect("reading from memory cannot fail")
}

/// A Cryptomatte layer.
#[derive(Clone, Debug, PartialEq)]
pub struct Cryptomatte {
    /// Name of the layer, e.g. `uCryptoObject`.
    pub layer: String,
    /// Id of every object of the manifest by name.
    pub objects: BTreeMap<String, u32>,
    /// Id (0 = none) and coverage in [0, 1] per pixel, most coverage first.
    pub ranks: Vec<(PixelGrid<u32>, PixelGrid<f32>)>,
}

impl Cryptomatte {
    /// The instance that covers most of each pixel, 0 where what belongs to no instance covers more. Objects of
    /// one instance count together; objects that `ids` does not know belong to none. Ties go to the lowest id.
    #[must_use]
    pub fn flatten(&self, ids: &ObjectIds) -> PixelGrid<u16> {
        let Some((first, _)) = self.ranks.first() else { return PixelGrid::filled(0, 0, 0) };
        let mut shares: Vec<(u16, f32)> = Vec::new();
        let pixels = (0..first.pixels.len())
            .map(|pixel| {
                shares.clear();
                let mut rest = 1.0_f32;
                for (objects, coverages) in &self.ranks {
                    let coverage = coverages.pixels[pixel];
                    let Some(id) = ids.get(&objects.pixels[pixel]).filter(|id| **id != 0) else { continue };
                    rest -= coverage;
                    match shares.iter_mut().find(|(known, _)| known == id) {
                        Some((_, share)) => *share += coverage,
                        None => shares.push((*id, coverage)),
                    }
                }
                let best = shares.iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
                best.filter(|(_, share)| *share > 0.0 && *share >= rest).map_or(0, |(id, _)| *id)
            })
            .collect();
        PixelGrid::from_pixels(first.width, first.height, pixels)
    }
}
