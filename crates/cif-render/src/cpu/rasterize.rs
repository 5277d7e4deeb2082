//! Front-to-back blending of one tile: colour, depth and the instance probability of each pixel's own label
//! in one pass with two transmittances. Source: methods reference 3.1 and 4.2.
//!
//! A tile's pixels are 32 groups of eight: group `half * 16 + row` holds eight neighbours of a row. A pixel
//! that is finished (or outside the image, or unlabelled in the instance pass) has its transmittance
//! negated, so one array says both how much light is left and whether anything still happens.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

use super::project::Splat;
use super::vector::{LANES, Lanes, exp2, load, splat};
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Groups per tile.
pub(super) const GROUPS: usize = (TILE * TILE) as usize / LANES;

/// Rows per tile; a group's row is its index modulo this.
pub(super) const ROWS: usize = TILE as usize;

/// One value per pixel of a tile.
pub(super) type TilePixels = [Lanes; GROUPS];

/// Pixel column and row of a lane inside its tile.
pub(super) fn pixel_in_tile(group: usize, lane: usize) -> (u32, u32) {
    (((group / ROWS) * LANES + lane) as u32, (group % ROWS) as u32)
}

/// Which slots of the tile's label list each pixel wants.
#[derive(Clone, Debug)]
pub(super) struct TileLabels {
    /// Dense instance indices that occur in the tile, ascending.
    pub(super) labels: Vec<u16>,
    /// Slot per pixel; 0 where unlabelled.
    pub(super) slots: [[u8; LANES]; GROUPS],
    /// The one slot of all labelled pixels of a group, or `None` when they differ.
    pub(super) uniform: [Option<u8>; GROUPS],
    /// Pixels that carry a label.
    pub(super) labelled: [u8; GROUPS],
}

impl TileLabels {
    /// Labels of a tile; `None` when no pixel carries one. `label_at` gives dense index + 1, 0 = unlabelled.
    pub(super) fn new(label_at: impl Fn(usize, usize) -> u16) -> Option<Self> {
        let mut labels = Vec::new();
        for group in 0..GROUPS {
            for lane in 0..LANES {
                let label = label_at(group, lane);
                if label > 0 && !labels.contains(&(label - 1)) {
                    labels.push(label - 1);
                }
            }
        }
        if labels.is_empty() {
            return None;
        }
        labels.sort_unstable();
        let mut tile =
            Self { labels, slots: [[0; LANES]; GROUPS], uniform: [None; GROUPS], labelled: [0; GROUPS] };
        for group in 0..GROUPS {
            let (mut first, mut mixed) = (None, false);
            for lane in 0..LANES {
                let label = label_at(group, lane);
                if label == 0 {
                    continue;
                }
                let slot = tile.labels.binary_search(&(label - 1)).expect("collected above") as u8;
                tile.slots[group][lane] = slot;
                tile.labelled[group] |= 1 << lane;
                mixed |= *first.get_or_insert(slot) != slot;
            }
            tile.uniform[group] = if mixed { None } else { first.or(Some(0)) };
        }
        Some(tile)
    }
}

/// Identity rows as the raster loops read them.
#[derive(Clone, Copy, Debug)]
pub(super) struct IdentityRows<'a> {
    pub(super) row_offsets: &'a [u32],
    pub(super) labels: &'a [u16],
    pub(super) probabilities: &'a [f32],
}

impl IdentityRows<'_> {
    /// Probabilities of a Gaussian at the tile's labels.
    #[inline(always)]
    pub(super) fn at_labels(&self, gaussian: u32, tile_labels: &[u16], out: &mut [f32]) {
        let range =
            self.row_offsets[gaussian as usize] as usize..self.row_offsets[gaussian as usize + 1] as usize;
        let labels = &self.labels[range.clone()];
        let probabilities = &self.probabilities[range];
        for (slot, wanted) in tile_labels.iter().enumerate() {
            out[slot] =
                labels.iter().position(|label| label == wanted).map_or(0.0, |entry| probabilities[entry]);
        }
    }
}

/// Blended values of a tile.
#[derive(Clone, Debug)]
pub(super) struct TileImage {
    pub(super) color: [TilePixels; 3],
    /// Weighted depth D.
    pub(super) depth: TilePixels,
    /// Colour transmittance at the end, positive for pixels of the image.
    pub(super) transmittance: TilePixels,
    /// Rendered probability M_y of the pixel's label.
    pub(super) label_probability: TilePixels,
    /// Instance transmittance at the end.
    pub(super) instance_transmittance: TilePixels,
    /// Evaluated (pixel, splat) pairs.
    pub(super) evaluated: u64,
}

impl Default for TileImage {
    fn default() -> Self {
        let zero = [[0.0; LANES]; GROUPS];
        Self {
            color: [zero; 3],
            depth: zero,
            transmittance: zero,
            label_probability: zero,
            instance_transmittance: zero,
            evaluated: 0,
        }
    }
}

/// Where a tile lies in its image.
#[derive(Clone, Copy, Debug)]
pub(super) struct TilePlace {
    pub(super) x: u32,
    pub(super) y: u32,
    pub(super) width: u32,
    pub(super) height: u32,
}

impl TilePlace {
    /// Transmittance at the start: 1 inside the image, -1 outside.
    pub(super) fn initial_transmittance(&self) -> TilePixels {
        std::array::from_fn(|group| {
            std::array::from_fn(|lane| {
                let (column, row) = pixel_in_tile(group, lane);
                if self.x + column < self.width && self.y + row < self.height { 1.0 } else { -1.0 }
            })
        })
    }
}

/// A splat prepared for one tile.
#[derive(Clone, Copy)]
pub(super) struct SplatInTile<S: Simd> {
    /// mean.x minus pixel centre, per half.
    pub(super) dx: [f32x8<S>; 2],
    /// mean.y minus the centre of the tile's first row.
    pub(super) dy: f32,
    /// Exponent of two of the footprint: a dx^2 + b dx dy + c dy^2.
    a: f32,
    b: f32,
    c: f32,
    /// Groups that the drawn ellipse of the colour and of the instance pass may touch.
    pub(super) groups: [u32; 2],
}

/// Prepares a splat for a tile; the instance pass's groups stay empty unless `INSTANCES`.
#[inline(always)]
pub(super) fn prepare<S: Simd, const INSTANCES: bool>(
    simd: S,
    s: &Splat,
    place: &TilePlace,
) -> SplatInTile<S> {
    let [x00, x01, x11] = s.conic;
    let first = s.mean[0] - (place.x as f32 + 0.5);
    let lanes = f32x8::load_array(simd, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    let dx = [splat(simd, first) - lanes, splat(simd, first - LANES as f32) - lanes];
    let dy = s.mean[1] - (place.y as f32 + 0.5);

    // Interval of x drawn in each row, for all rows at once: sigma <= reach is a quadratic in dx. A hair
    // wider than exact, so that rounding never hides a drawn pixel; the gate itself decides.
    let inverse = 1.0 / x00;
    let slope = x01 * inverse;
    let curvature = splat(simd, -(x11 - x01 * slope));
    let mut groups = [0_u32; 2];
    for block in 0..2 {
        let row_dy = splat(simd, dy - (block * LANES) as f32) - lanes;
        let squared = row_dy * row_dy;
        // Position of the drawn interval's centre, in pixels from the tile's first pixel centre.
        let centre = row_dy.mul_add(splat(simd, slope), splat(simd, first));
        for pass in 0..1 + usize::from(INSTANCES) {
            let reach = splat(simd, s.reach[pass] * 2.0 * 1.000_02 + 2e-5);
            let discriminant = squared.mul_add(curvature, reach) * splat(simd, inverse);
            let reaches = discriminant.simd_gt(splat(simd, 0.0));
            let half_width = discriminant.max(splat(simd, 0.0)).sqrt() + splat(simd, 1e-3);
            let (low, high) = (centre - half_width, centre + half_width);
            for half in 0..2 {
                let start = (half * LANES) as f32;
                let hits = reaches
                    & high.simd_ge(splat(simd, start))
                    & low.simd_le(splat(simd, start + (LANES - 1) as f32));
                groups[pass] |= (hits.to_bitmask() as u32) << (half * ROWS + block * LANES);
            }
        }
    }
    let scale = -std::f32::consts::LOG2_E;
    SplatInTile { dx, dy, a: 0.5 * scale * x00, b: scale * x01, c: 0.5 * scale * x11, groups }
}

impl<S: Simd> SplatInTile<S> {
    /// dx and dy of a group.
    #[inline(always)]
    pub(super) fn offset(&self, group: usize) -> (f32x8<S>, f32) {
        (self.dx[group / ROWS], self.dy - (group % ROWS) as f32)
    }

    /// Footprint P and the mask of pixels where it is valid (sigma >= 0).
    #[inline(always)]
    pub(super) fn footprint(&self, simd: S, dx: f32x8<S>, dy: f32) -> (f32x8<S>, fearless_simd::mask32x8<S>) {
        let exponent = dx
            .mul_add(splat(simd, self.a), splat(simd, self.b * dy))
            .mul_add(dx, splat(simd, self.c * dy * dy));
        (exp2(simd, exponent), exponent.simd_le(splat(simd, 0.0)))
    }
}

/// Blends a tile. `labels` are read when `INSTANCES`.
#[simd]
pub(super) fn rasterize_tile<S: Simd, const INSTANCES: bool, const DEPTH: bool>(
    simd: S,
    splats: &[Splat],
    ranks: &[u32],
    place: &TilePlace,
    labels: Option<(&TileLabels, IdentityRows<'_>)>,
    image: &mut TileImage,
) {
    let zero = splat(simd, 0.0);
    let one = splat(simd, 1.0);
    let min_alpha = splat(simd, MIN_ALPHA);
    let max_alpha = splat(simd, MAX_ALPHA);
    let min_transmittance = splat(simd, MIN_TRANSMITTANCE);
    image.color = [[[0.0; LANES]; GROUPS]; 3];
    if DEPTH {
        image.depth = [[0.0; LANES]; GROUPS];
    }
    image.transmittance = place.initial_transmittance();
    image.evaluated = 0;
    let mut slot_probabilities = Vec::new();
    let (mut live_color, mut live_instances) = (0_u32, 0_u32);
    for group in 0..GROUPS {
        live_color |= u32::from(image.transmittance[group].iter().any(|t| *t > 0.0)) << group;
    }
    if INSTANCES && let Some((tile_labels, _)) = labels {
        image.label_probability = [[0.0; LANES]; GROUPS];
        for group in 0..GROUPS {
            for lane in 0..LANES {
                let labelled = tile_labels.labelled[group] >> lane & 1 == 1;
                image.instance_transmittance[group][lane] = if labelled { 1.0 } else { -1.0 };
            }
            live_instances |= u32::from(tile_labels.labelled[group] != 0) << group;
        }
        slot_probabilities.resize(tile_labels.labels.len(), 0.0);
    }

    for &rank in ranks {
        if live_color | live_instances == 0 {
            break;
        }
        let s = &splats[rank as usize];
        let prepared = prepare::<S, INSTANCES>(simd, s, place);
        let color_groups = prepared.groups[0] & live_color;
        let instance_groups = prepared.groups[1] & live_instances;
        let mut groups = color_groups | instance_groups;
        if groups == 0 {
            continue;
        }
        image.evaluated += u64::from(groups.count_ones()) * LANES as u64;
        if INSTANCES
            && let Some((tile_labels, rows)) = labels
            && instance_groups != 0
        {
            rows.at_labels(s.gaussian, &tile_labels.labels, &mut slot_probabilities);
        }
        let opacity = splat(simd, s.opacity);
        let occupancy = splat(simd, s.occupancy);
        while groups != 0 {
            let group = groups.trailing_zeros() as usize;
            groups &= groups - 1;
            let (dx, dy) = prepared.offset(group);
            let (p, valid) = prepared.footprint(simd, dx, dy);

            let alpha = (opacity * p).min(max_alpha);
            let t = load(simd, &image.transmittance[group]);
            let draws = valid & alpha.simd_ge(min_alpha) & t.simd_gt(zero);
            if draws.to_bitmask() != 0 {
                let next = t * (one - alpha);
                let stops = draws & next.simd_lt(min_transmittance);
                let blends = draws & !stops;
                let weight = blends.select(t * alpha, zero);
                for channel in 0..3 {
                    let c = load(simd, &image.color[channel][group]);
                    weight
                        .mul_add(splat(simd, s.color[channel]), c)
                        .store_array(&mut image.color[channel][group]);
                }
                if DEPTH {
                    let d = load(simd, &image.depth[group]);
                    weight.mul_add(splat(simd, s.depth), d).store_array(&mut image.depth[group]);
                }
                let t = stops.select(-t, blends.select(next, t));
                t.store_array(&mut image.transmittance[group]);
                if stops.to_bitmask() != 0 && t.simd_gt(zero).to_bitmask() == 0 {
                    live_color &= !(1 << group);
                }
            }

            if INSTANCES
                && instance_groups >> group & 1 == 1
                && let Some((tile_labels, _)) = labels
            {
                let b = (occupancy * p).min(max_alpha);
                let t = load(simd, &image.instance_transmittance[group]);
                let draws = valid & b.simd_ge(min_alpha) & t.simd_gt(zero);
                if draws.to_bitmask() != 0 {
                    let next = t * (one - b);
                    let stops = draws & next.simd_lt(min_transmittance);
                    let blends = draws & !stops;
                    let weight = blends.select(t * b, zero);
                    let identity = slot_values(simd, tile_labels, group, &slot_probabilities);
                    let m = load(simd, &image.label_probability[group]);
                    weight.mul_add(identity, m).store_array(&mut image.label_probability[group]);
                    let t = stops.select(-t, blends.select(next, t));
                    t.store_array(&mut image.instance_transmittance[group]);
                    if stops.to_bitmask() != 0 && t.simd_gt(zero).to_bitmask() == 0 {
                        live_instances &= !(1 << group);
                    }
                }
            }
        }
    }
    for group in 0..GROUPS {
        load(simd, &image.transmittance[group]).abs().store_array(&mut image.transmittance[group]);
        if INSTANCES {
            load(simd, &image.instance_transmittance[group])
                .abs()
                .store_array(&mut image.instance_transmittance[group]);
        }
    }
}

/// The value of each pixel's own label slot.
#[inline(always)]
pub(super) fn slot_values<S: Simd>(simd: S, labels: &TileLabels, group: usize, values: &[f32]) -> f32x8<S> {
    match labels.uniform[group] {
        Some(slot) => splat(simd, values[slot as usize]),
        None => {
            let slots = &labels.slots[group];
            f32x8::load_array(simd, slots.map(|slot| values[slot as usize]))
        }
    }
}
