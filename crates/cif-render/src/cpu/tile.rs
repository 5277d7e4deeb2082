//! A tile, its pixels, and how one splat falls on them and blends. Everything that walks a tile's splats
//! (colour, instances, label mass, either direction) uses these steps, so that all take the same decisions.
//! Source: methods reference 3.1.
//!
//! A tile's pixels are sixteen groups of two rows by eight columns: group `half * 8 + pair` holds rows
//! `2 pair` and `2 pair + 1` of the left or right half. Sets of groups are bit sets with one bit per row of
//! each half, `half * 16 + row`, of which the even rows are used: bit `2 group` is the group's.

use fearless_simd::prelude::*;
use fearless_simd::{f32x16, mask32x16};

use super::functions::exp2_negative;
use super::pixels::{LANES, Lanes, load, splat};
use super::project::Splat;
use crate::constants::{MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, TILE};

/// Groups per tile.
pub(super) const GROUPS: usize = (TILE * TILE) as usize / LANES;

/// Columns of a group.
const COLUMNS: usize = 8;

/// Groups of a half tile.
const PAIRS: usize = GROUPS / 2;

/// One value per pixel of a tile. Structures that hold some begin a cache line with them, so that no vector lies across
/// two.
pub(super) type TilePixels = [Lanes; GROUPS];

/// A value that begins a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub(super) struct Aligned<T>(pub(super) T);

/// Pixel column and row of a lane inside its tile.
pub(super) fn pixel_in_tile(group: usize, lane: usize) -> (u32, u32) {
    ((group / PAIRS * COLUMNS + lane % COLUMNS) as u32, (group % PAIRS * 2 + lane / COLUMNS) as u32)
}

/// A set of groups.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Groups(u32);

impl Groups {
    /// Groups for which `holds`.
    #[inline(always)]
    pub(super) fn where_(holds: impl Fn(usize) -> bool) -> Self {
        let mut groups = 0;
        for group in 0..GROUPS {
            groups |= u32::from(holds(group)) << (2 * group);
        }
        Self(groups)
    }

    #[inline(always)]
    pub(super) fn is_empty(self) -> bool {
        self.0 == 0
    }

    #[inline(always)]
    pub(super) fn union(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    #[inline(always)]
    pub(super) fn both(self, other: Self) -> Self {
        Self(self.0 & other.0)
    }

    #[inline(always)]
    pub(super) fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    /// Takes a group out when it is `finished`.
    #[inline(always)]
    pub(super) fn finish(&mut self, group: usize, finished: bool) {
        self.0 &= !(u32::from(finished) << (2 * group));
    }

    #[inline(always)]
    pub(super) fn pixels(self) -> u64 {
        u64::from(self.0.count_ones()) * LANES as u64
    }
}

impl Iterator for Groups {
    type Item = usize;

    #[inline(always)]
    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let group = self.0.trailing_zeros() as usize / 2;
        self.0 &= self.0 - 1;
        Some(group)
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
    /// Position in the image of a lane; `None` outside.
    #[inline(always)]
    pub(super) fn pixel(&self, group: usize, lane: usize) -> Option<usize> {
        let (column, row) = pixel_in_tile(group, lane);
        let (x, y) = (self.x + column, self.y + row);
        (x < self.width && y < self.height).then(|| y as usize * self.width as usize + x as usize)
    }

    /// From the first pixel's centre to the mean of a splat, pixels.
    #[inline(always)]
    fn offset_of(&self, s: &Splat) -> [f32; 2] {
        [s.mean[0] - (self.x as f32 + 0.5), s.mean[1] - (self.y as f32 + 0.5)]
    }

    /// Transmittance at the start: 1 inside the image, -1 outside.
    pub(super) fn initial_transmittance(&self) -> TilePixels {
        std::array::from_fn(|group| {
            std::array::from_fn(|lane| if self.pixel(group, lane).is_some() { 1.0 } else { -1.0 })
        })
    }
}

/// Groups with a pixel that still lets light through.
pub(super) fn live(transmittance: &TilePixels) -> Groups {
    Groups::where_(|group| transmittance[group].iter().any(|t| *t > 0.0))
}

/// Minus the first rows of the groups of a half tile.
const ROWS_BEFORE: [f32; PAIRS] = [0.0, -2.0, -4.0, -6.0, -8.0, -10.0, -12.0, -14.0];

/// Column of each lane.
const LANE_COLUMNS: Lanes = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0];

/// Row of each lane inside its group.
const LANE_ROWS: Lanes = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0];

/// All rows of a tile.
const ROWS: Lanes = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];

/// A splat prepared for one tile, by `u = L d` with [`Splat::binary_factor`] and d the mean minus a pixel centre.
#[derive(Clone, Copy)]
pub(super) struct SplatInTile<S: Simd> {
    /// u0 in the first pair of rows, per half.
    u0: [f32x16<S>; 2],
    /// u1 in the first pair of rows.
    u1: f32x16<S>,
    /// Decrease of `u0` and of `u1` per row.
    l01: f32x16<S>,
    l11: f32x16<S>,
    /// Groups that the drawn ellipse of each pass may touch, of those asked for.
    pub(super) groups: [Groups; 2],
}

/// The groups that the drawn ellipses of a splat may touch, of those `needed` by each pass.
///
/// All rows at once: the nearest point to the ellipse's centre line of a row of eight pixels is drawn when
/// `u0^2 <= 2 reach - u1^2` there. It is a hair wider than exact, so that rounding never hides a drawn pixel; the gate
/// itself decides.
#[inline(always)]
fn touched<S: Simd>(simd: S, s: &Splat, first: f32, dy: f32, needed: [Groups; 2]) -> [Groups; 2] {
    let [l00, l01, l11] = s.factor;
    let zero = splat(simd, 0.0);
    let row_dy = splat(simd, dy) - load(simd, &ROWS);
    let bend = row_dy * row_dy * splat(simd, -(l11 * l11));
    // Position of the drawn interval's centre, in pixels from the tile's first pixel centre.
    let centre = row_dy.mul_add(splat(simd, l01 / l00), splat(simd, first + 1e-3));
    // Distances from there to the pixels of each half, 0 inside.
    let last = (COLUMNS - 1) as f32;
    let beyond = centre - splat(simd, last + 2e-3);
    let half = splat(simd, COLUMNS as f32);
    let left = beyond.max(-centre).max(zero) * l00;
    let right = (beyond - half).max(half - centre).max(zero) * l00;
    let squared = [left * left, right * right];
    let mut groups = [Groups::default(); 2];
    for pass in 0..2 {
        if needed[pass].is_empty() {
            continue;
        }
        let room = bend + splat(simd, s.reach[pass] * 2.0 * 1.000_02 + 2e-5);
        let mut rows = 0_u32;
        for half in 0..2 {
            rows |= (squared[half].simd_le(room).to_bitmask() as u32) << (half * ROWS.len());
        }
        groups[pass] = Groups((rows | rows >> 1) & 0x5555_5555).both(needed[pass]);
    }
    groups
}

/// Prepares a splat for a tile; `None` where it touches none of the groups that the passes want.
#[inline(always)]
pub(super) fn prepare<S: Simd>(
    simd: S,
    s: &Splat,
    place: &TilePlace,
    needed: [Groups; 2],
) -> Option<SplatInTile<S>> {
    let [first, first_dy] = place.offset_of(s);
    let groups = touched(simd, s, first, first_dy, needed);
    if groups[0].union(groups[1]).is_empty() {
        return None;
    }
    Some(SplatInTile::new(simd, s, place, groups))
}

/// The groups in which each pass met a splat.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct MetGroups(u32);

impl MetGroups {
    #[inline(always)]
    pub(super) fn new([color, instances]: [Groups; 2]) -> Self {
        Self(color.0 | instances.0 << 1)
    }

    /// Those that are still live in each pass.
    #[inline(always)]
    pub(super) fn live<const INSTANCES: bool>(self, color: Groups, instances: Groups) -> [Groups; 2] {
        let met = Groups(self.0 >> 1 & 0x5555_5555);
        [Groups(self.0).both(color), if INSTANCES { met.both(instances) } else { Groups::default() }]
    }
}

/// A splat on the pixels of a group.
#[derive(Clone, Copy)]
pub(super) struct Footprint<S: Simd> {
    /// L d with [`Splat::binary_factor`].
    pub(super) u0: f32x16<S>,
    pub(super) u1: f32x16<S>,
    /// Footprint P.
    pub(super) peak: f32x16<S>,
}

impl<S: Simd> SplatInTile<S> {
    /// A splat that touches these groups.
    #[inline(always)]
    pub(super) fn new(simd: S, s: &Splat, place: &TilePlace, groups: [Groups; 2]) -> Self {
        let [first, first_dy] = place.offset_of(s);
        let [l00, l01, l11] = s.binary_factor();
        let (l00, l01, l11) = (splat(simd, l00), splat(simd, l01), splat(simd, l11));
        let columns = load(simd, &LANE_COLUMNS);
        let dy = splat(simd, first_dy) - load(simd, &LANE_ROWS);
        let sideways = l01 * dy;
        let left = (splat(simd, first) - columns).mul_add(l00, sideways);
        let right = (splat(simd, first - COLUMNS as f32) - columns).mul_add(l00, sideways);
        Self { u0: [left, right], u1: l11 * dy, l01, l11, groups }
    }

    #[inline(always)]
    pub(super) fn footprint(&self, simd: S, group: usize) -> Footprint<S> {
        let row = splat(simd, ROWS_BEFORE[group % PAIRS]);
        let u0 = self.l01.mul_add(row, self.u0[group / PAIRS]);
        let u1 = self.l11.mul_add(row, self.u1);
        Footprint { u0, u1, peak: exp2_negative(simd, u1.mul_add(u1, u0 * u0)) }
    }
}

/// The blending rule. A pixel that is finished has its transmittance negated, so that one value says both how
/// much light is left and whether anything still happens.
#[derive(Clone, Copy)]
pub(super) struct BlendingRule<S: Simd> {
    zero: f32x16<S>,
    one: f32x16<S>,
    min_alpha: f32x16<S>,
    max_alpha: f32x16<S>,
    min_transmittance: f32x16<S>,
}

/// Result of blending one splat into the pixels of a group.
pub(super) struct Blended<S: Simd> {
    /// Blending weight alpha, clamped, also where it is not drawn.
    pub(super) alpha: f32x16<S>,
    /// Transmittance before.
    pub(super) transmittance: f32x16<S>,
    /// Where it is drawn.
    pub(super) drawn: mask32x16<S>,
    /// T alpha where drawn, else 0.
    pub(super) weight: f32x16<S>,
    /// True when no pixel of the group lets light through any more.
    pub(super) finished: bool,
}

impl<S: Simd> BlendingRule<S> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        Self {
            zero: splat(simd, 0.0),
            one: splat(simd, 1.0),
            min_alpha: splat(simd, MIN_ALPHA),
            max_alpha: splat(simd, MAX_ALPHA),
            min_transmittance: splat(simd, MIN_TRANSMITTANCE),
        }
    }

    /// Blends a weight that is not clamped yet and steps the transmittance.
    #[inline(always)]
    pub(super) fn step(&self, simd: S, unclamped: f32x16<S>, transmittance: &mut Lanes) -> Blended<S> {
        let alpha = unclamped.min(self.max_alpha);
        let t = load(simd, transmittance);
        let weight = t * alpha;
        let next = t - weight;
        let strong = alpha.simd_ge(self.min_alpha);
        // Negative for finished pixels, which are so neither drawn nor changed.
        let drawn = strong & next.simd_ge(self.min_transmittance);
        let after = drawn.select(next, strong.select(-t.abs(), t));
        after.store_array(transmittance);
        Blended {
            alpha,
            transmittance: t,
            drawn,
            weight: drawn.select(weight, self.zero),
            finished: after.simd_gt(self.zero).to_bitmask() == 0,
        }
    }

    /// The gradient by a weight that [`Self::step`] blended, 0 where none flows. `e` is the gradient along what the
    /// splat shows; `remainder` holds what is left of the sum of all `T alpha e` behind the splats so far.
    #[inline(always)]
    pub(super) fn backward(
        &self,
        simd: S,
        blended: &Blended<S>,
        unclamped: f32x16<S>,
        e: f32x16<S>,
        remainder: &mut Lanes,
    ) -> f32x16<S> {
        let left = load(simd, remainder) - blended.weight * e;
        left.store_array(remainder);
        let v_alpha = blended.transmittance.mul_add(e, -(left / (self.one - blended.alpha)));
        (blended.drawn & self.unclamped(unclamped)).select(v_alpha, self.zero)
    }

    /// Where a weight was not clamped, so that gradients flow through it.
    #[inline(always)]
    pub(super) fn unclamped(&self, weight: f32x16<S>) -> mask32x16<S> {
        weight.simd_le(self.max_alpha)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lanes_cover_the_tile_once() {
        let mut seen = [[false; TILE as usize]; TILE as usize];
        for group in 0..GROUPS {
            for lane in 0..LANES {
                let (column, row) = pixel_in_tile(group, lane);
                assert_eq!(column % 8, LANE_COLUMNS[lane] as u32);
                assert_eq!(row, -ROWS_BEFORE[group % PAIRS] as u32 + LANE_ROWS[lane] as u32);
                assert!(!std::mem::replace(&mut seen[row as usize][column as usize], true));
            }
        }
    }

    #[test]
    fn sets_of_groups_list_their_members() {
        let mut set = Groups::where_(|group| group % 5 == 1);
        assert_eq!(set.collect::<Vec<_>>(), [1, 6, 11]);
        assert_eq!(set.pixels(), 48);
        set.finish(6, true);
        set.finish(11, false);
        assert_eq!(set.collect::<Vec<_>>(), [1, 11]);
        let other = Groups::where_(|group| group > 10);
        assert_eq!(set.both(other).collect::<Vec<_>>(), [11]);
        assert_eq!(set.without(other).collect::<Vec<_>>(), [1]);
        assert_eq!(set.union(other).collect::<Vec<_>>(), [1, 11, 12, 13, 14, 15]);
    }
}
