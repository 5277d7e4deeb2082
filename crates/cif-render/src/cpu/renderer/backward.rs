//! Gradients of the last forward pass.

use cif_field::parameters::{OCCUPANCY_LOGITS, Parameter, SH_COEFFICIENTS};
use cif_field::{Field, Gaussians, Tracks};
use cif_geometry::PixelGrid;
use fearless_simd::dispatch;
use rayon::prelude::*;

use super::super::deform::DeformationAtTime;
use super::super::groups::groups_backward;
use super::super::labels::{IdentityRows, TileLabels};
use super::super::pixels::LANES;
use super::super::posed::{PosedView, has_posed_colors};
use super::super::project::ViewConstants;
use super::super::project_backward::{DrawnGaussians, PosedGradient, SplatGradient, project_backward};
use super::super::rasterize::TileImage;
use super::super::rasterize_backward::{DrawnTile, TileCotangents, TileInstances, rasterize_tile_backward};
use super::super::tile::{GROUPS, TilePixels, TilePlace};
use super::super::timing::timed;
use super::state::{CHUNK, NOT_VISIBLE, Renderer};
use crate::constants::MIN_LABEL_PROBABILITY;
use crate::{Gradients, InstanceNormalisation, RenderSettings};

/// Weighted label responsibilities of (tile, splat) pairs.
struct LabelMass {
    /// `[tiles + 1]` first value of each tile.
    offsets: Vec<usize>,
    /// `[pairs of the tile, labels of the tile]` for each tile.
    values: Vec<f32>,
}

impl Renderer {
    /// Adds the gradients of the last forward pass: `v_color` is dL/dcolour per pixel, `instance_weight`
    /// multiplies the view's mean instance loss.
    ///
    /// # Panics
    /// Without a forward pass before, when sizes differ from it, or when the field has recorded motion, which is
    /// not differentiated.
    pub fn backward(
        &mut self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        instance_weight: f32,
        gradients: &mut Gradients,
    ) {
        self.backward_displaced(field, v_color, instance_weight, &[], gradients);
    }

    /// [`Self::backward`] of colours and of `v_alpha`, dL/dalpha per pixel; see [`Self::alpha`].
    ///
    /// # Panics
    /// As [`Self::backward`].
    pub fn backward_with_alpha(
        &mut self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        v_alpha: &PixelGrid<f32>,
        gradients: &mut Gradients,
    ) {
        self.view_backward(field, v_color, Some(v_alpha), 0.0, &[], gradients);
    }

    /// [`Self::backward`] with gradients of its own by what the deformation adds to the centres, `[N, 3]`, or
    /// empty: they train the deformation, and leave the canonical centres to the image.
    ///
    /// # Panics
    /// As [`Self::backward`].
    pub fn backward_displaced(
        &mut self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        instance_weight: f32,
        v_displacements: &[[f32; 3]],
        gradients: &mut Gradients,
    ) {
        self.view_backward(field, v_color, None, instance_weight, v_displacements, gradients);
    }

    fn view_backward(
        &mut self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        v_alpha: Option<&PixelGrid<f32>>,
        instance_weight: f32,
        v_displacements: &[[f32; 3]],
        gradients: &mut Gradients,
    ) {
        let (view, settings, _) = self.tape.view.expect("backward follows a forward pass");
        assert_eq!((v_color.width, v_color.height), (view.width, view.height), "cotangent size");
        if let Some(v_alpha) = v_alpha {
            assert_eq!((v_alpha.width, v_alpha.height), (view.width, view.height), "cotangent size");
        }
        let mut times = self.times;
        let mut pairs = std::mem::take(&mut self.pair_gradients);
        let label_mass = timed(&mut times.rasterize_backward, || {
            self.rasterize_backward(field, v_color, v_alpha, instance_weight, &settings, &mut pairs)
        });
        self.inspection.look_at_pairs(&pairs, &label_mass.values);
        timed(&mut times.project_backward, || self.calibration_backward(field, &label_mass, gradients));
        self.times = times;
        self.splats_backward(field, &pairs, v_displacements, gradients);
        self.pair_gradients = pairs;
    }

    /// Carries gradients of (tile, splat) pairs, and those by what the deformation adds to the centres, to the
    /// parameters.
    ///
    /// # Panics
    /// When the field has recorded motion.
    pub(super) fn splats_backward(
        &mut self,
        field: &Field,
        pairs: &[SplatGradient],
        v_displacements: &[[f32; 3]],
        gradients: &mut Gradients,
    ) {
        assert!(
            field.tracks.as_ref().is_none_or(Tracks::is_rigid),
            "sampled motion has no gradients: trainers refuse such fields"
        );
        let (view, settings, time) = self.tape.view.expect("backward follows a forward pass");
        let mut times = self.times;
        let n = field.gaussians.len();
        let deformation =
            field.deformation.as_ref().filter(|_| settings.deform).map(|d| DeformationAtTime::new(d, time));
        let mut v_posed = std::mem::take(&mut self.v_posed);
        let with_gradient = timed(&mut times.project_backward, || {
            self.project_backward(field, &view, pairs, gradients, &mut v_posed)
        });
        if let Some(tracks) = &field.tracks {
            timed(&mut times.project_backward, || {
                let at = tracks.at(time);
                groups_backward(tracks, &at, time, &field.gaussians, &mut v_posed, gradients);
            });
        }
        timed(&mut times.project_backward, || {
            let total = gradients.gaussians.sh_coefficients.par_iter_mut().with_min_len(CHUNK);
            total.zip(&v_posed.sh_coefficients).enumerate().for_each(|(row, (total, v))| {
                if has_posed_colors(field, row) {
                    total.iter_mut().zip(v).for_each(|(total, v)| *total += v);
                }
            });
        });
        self.inspection.look_at_posed_gradients(&v_posed, gradients);
        if let Some(deformation) = deformation {
            timed(&mut times.deform_backward, || {
                for (total, v) in
                    v_posed.means.as_flattened_mut().iter_mut().zip(v_displacements.as_flattened())
                {
                    *total += v;
                }
                let is_grouped =
                    |row: usize| field.tracks.as_ref().is_some_and(|tracks| tracks.group(row).is_some());
                let is_displaced =
                    |row: u32| v_displacements.get(row as usize).is_some_and(|v| *v != [0.0; 3]);
                let mut with_gradient = with_gradient.into_iter().peekable();
                let active: Vec<u32> = (0..n as u32)
                    .filter(|row| with_gradient.next_if_eq(row).is_some() || is_displaced(*row))
                    .filter(|row| deformation.moves(*row as usize) && !is_grouped(*row as usize))
                    .collect();
                self.statistics.deformed_backward = active.len();
                deformation.backward(
                    self.level,
                    &field.gaussians,
                    &active,
                    &v_posed,
                    &mut self.deform_scratch,
                    &mut gradients.planes,
                    &mut gradients.mlp,
                    &mut gradients.gaussians.means,
                );
            });
            self.inspection.look_at_deformation_gradients(gradients);
        }
        self.v_posed = v_posed;
        self.times = times;
    }

    /// Sets the gradients of (tile, splat) pairs, and returns their label masses.
    fn rasterize_backward(
        &self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        v_alpha: Option<&PixelGrid<f32>>,
        instance_weight: f32,
        settings: &RenderSettings,
        pairs: &mut Vec<SplatGradient>,
    ) -> LabelMass {
        let tape = &self.tape;
        let lists = &tape.lists;
        let trains_instances = instance_weight != 0.0 && tape.labelled_pixels > 0;
        let rows = field.identities.as_ref().map(|rows| IdentityRows::new(rows, &tape.probabilities));
        let instances = |tile: usize| {
            let labels = tape.labels[tile].as_ref().filter(|_| trains_instances)?;
            Some((labels, rows?))
        };
        let mut offsets = vec![0_usize];
        for tile in 0..lists.tiles() {
            let slots = instances(tile).map_or(0, |(labels, _)| labels.labels.len());
            offsets.push(offsets[tile] + slots * lists.tile(tile).len());
        }
        pairs.clear();
        pairs.resize(lists.entries.len(), SplatGradient::default());
        let mut values = vec![0.0_f32; offsets[lists.tiles()]];
        let mut tasks = Vec::with_capacity(lists.tiles());
        let (mut pair_rest, mut mass_rest) = (&mut pairs[..], &mut values[..]);
        for tile in 0..lists.tiles() {
            let (pairs, rest) = pair_rest.split_at_mut(lists.tile(tile).len());
            pair_rest = rest;
            let (mass, rest) = mass_rest.split_at_mut(offsets[tile + 1] - offsets[tile]);
            mass_rest = rest;
            tasks.push((tile, pairs, mass));
        }
        let pixel_weight = instance_weight / tape.labelled_pixels.max(1) as f32;
        let level = self.level;
        tasks.into_par_iter().for_each(|(tile, pairs, mass)| {
            if pairs.is_empty() {
                return;
            }
            let place = self.place(tile);
            let drawn = DrawnTile {
                splats: &tape.splats,
                entries: lists.tile(tile),
                met: &tape.tiles[tile].met,
                place: &place,
            };
            let mut cotangents = tile_cotangents(&place, &v_color.pixels, &tape.color);
            if let Some(v_alpha) = v_alpha {
                add_alpha(&mut cotangents, &place, &v_alpha.pixels, &tape.tiles[tile].transmittance);
            }
            let instances = instances(tile).map(|(labels, rows)| {
                let (inverse_probability, coverage_ratio) =
                    instance_cotangents(labels, &tape.tiles[tile], settings);
                TileInstances {
                    labels,
                    rows,
                    geometry: settings.instances.unwrap_or_default().geometry,
                    weight: pixel_weight,
                    inverse_probability,
                    ends: tape.tiles[tile].supported,
                    coverage_ratio,
                }
            });
            dispatch!(level, simd => if instances.is_some() {
                rasterize_tile_backward::<_, true>(
                    simd, drawn, &mut cotangents, instances.as_ref(), pairs, mass);
            } else {
                rasterize_tile_backward::<_, false>(
                    simd, drawn, &mut cotangents, None, pairs, mass);
            });
        });
        LabelMass { offsets, values }
    }

    /// Sums of the pairs of each splat, in depth order, as pairs lie in the lists of tiles: by rows, each would be fetched
    /// from memory on its own.
    fn splat_sums(&self, pairs: &[SplatGradient]) -> Vec<SplatGradient> {
        let tape = &self.tape;
        (0..tape.splats.len())
            .into_par_iter()
            .with_min_len(CHUNK)
            .map(|rank| {
                let mut sum = SplatGradient::default();
                for &pair in tape.lists.pairs_of(rank) {
                    sum.add(&pairs[pair as usize]);
                }
                sum
            })
            .collect()
    }

    /// Sums each splat's pairs and carries them to the raw parameters. Returns the rows with a gradient by what a
    /// deformation moves, ascending.
    fn project_backward(
        &self,
        field: &Field,
        view: &ViewConstants,
        pairs: &[SplatGradient],
        gradients: &mut Gradients,
        v_posed: &mut Gaussians,
    ) -> Vec<u32> {
        let tape = &self.tape;
        let n = field.gaussians.len();
        let rank_of = self.ranks(n);
        let sums = self.splat_sums(pairs);
        let posed = PosedView::new(field, &tape.posed);
        let moves_sh = !tape.posed.sh_coefficients.is_empty();
        let is_moved = |parameter: &Parameter| match *parameter {
            OCCUPANCY_LOGITS => false,
            SH_COEFFICIENTS => moves_sh,
            _ => true,
        };
        reset(v_posed, field, is_moved);
        let half = [view.width as f32 / 2.0, view.height as f32 / 2.0];
        let level = self.level;
        let rows = gradients.gaussians.rows_mut().chunks(CHUNK, n).into_par_iter();
        let posed_rows: Vec<Vec<u32>> = rows
            .zip(v_posed.rows_mut().chunks(CHUNK, n))
            .zip(gradients.screen.par_chunks_mut(CHUNK))
            .zip(gradients.radii.par_chunks_mut(CHUNK))
            .enumerate()
            .map(|(chunk, (((total, of_view), screen), radii))| {
                let mut found = Vec::with_capacity(radii.len());
                let mut posed_rows = Vec::new();
                for row in 0..radii.len() {
                    let rank = rank_of[chunk * CHUNK + row];
                    if rank == NOT_VISIBLE {
                        continue;
                    }
                    let splat = &tape.splats[rank as usize];
                    radii[row] = splat.radius.max(radii[row]);
                    let v = sums[rank as usize];
                    if v != SplatGradient::default() {
                        found.push((row, splat, v));
                    }
                }
                for found in found.chunks(LANES) {
                    let mut drawn = DrawnGaussians::new(posed.sh(found[0].1.gaussian as usize));
                    for (lane, (_, splat, v)) in found.iter().enumerate() {
                        drawn.set(lane, &posed, splat, v);
                    }
                    let posed_gradients = dispatch!(level, simd => project_backward(simd, view, &drawn));
                    for (lane, (row, splat, v)) in found.iter().enumerate() {
                        let (row, gaussian) = (*row, splat.gaussian as usize);
                        let sh = if moves_sh && has_posed_colors(field, gaussian) {
                            &mut of_view.sh_coefficients[row]
                        } else {
                            &mut total.sh_coefficients[row]
                        };
                        posed_gradients.add_sh(lane, sh);
                        let PosedGradient { mean, log_scale, quaternion, opacity_logit, occupancy_logit } =
                            posed_gradients.of(lane);
                        for axis in 0..2 {
                            screen[row][axis] += half[axis] * v.mean[axis];
                        }
                        for axis in 0..3 {
                            total.log_scales[row][axis] += log_scale[axis];
                        }
                        if field.tracks.as_ref().and_then(|tracks| tracks.group(gaussian)).is_none() {
                            for axis in 0..3 {
                                total.means[row][axis] += mean[axis];
                            }
                            for axis in 0..4 {
                                total.quaternions[row][axis] += quaternion[axis];
                            }
                        }
                        total.opacity_logits[row] += opacity_logit;
                        total.occupancy_logits[row] += occupancy_logit;
                        of_view.means[row] = mean;
                        of_view.log_scales[row] = log_scale;
                        of_view.quaternions[row] = quaternion;
                        of_view.opacity_logits[row] = opacity_logit;
                        // Losses of identities may reach occupancies alone.
                        if v.color != [0.0; 3]
                            || opacity_logit != 0.0
                            || mean != [0.0; 3]
                            || log_scale != [0.0; 3]
                            || quaternion != [0.0; 4]
                        {
                            posed_rows.push(splat.gaussian);
                        }
                    }
                }
                posed_rows
            })
            .collect();
        posed_rows.concat()
    }

    /// `v_mu_i^k = -(rho_i^k - p_i^k R_i)` (methods reference 4.2).
    fn calibration_backward(&self, field: &Field, label_mass: &LabelMass, gradients: &mut Gradients) {
        let LabelMass { offsets, values } = label_mass;
        let Some(identities) = field.identities.as_ref().filter(|_| !values.is_empty()) else { return };
        let tape = &self.tape;
        let tile_of_pair = tape.lists.tile_of_pair();
        // Chunks of splats find their gradients side by side; rows belong to one splat each.
        let chunks: Vec<Vec<(usize, f32)>> = tape
            .splats
            .par_chunks(CHUNK)
            .enumerate()
            .map(|(chunk, splats)| {
                let mut found = Vec::new();
                let mut mass = Vec::new();
                for (k, splat) in splats.iter().enumerate() {
                    let entries = identities.range(splat.gaussian as usize);
                    mass.clear();
                    mass.resize(entries.len(), 0.0_f32);
                    for &pair in tape.lists.pairs_of(chunk * CHUNK + k) {
                        let tile = tile_of_pair[pair as usize] as usize;
                        if offsets[tile + 1] == offsets[tile] {
                            continue;
                        }
                        let Some(labels) = &tape.labels[tile] else { continue };
                        let local = pair as usize - tape.lists.tile_offsets[tile] as usize;
                        let start = offsets[tile] + local * labels.labels.len();
                        for (label, value) in labels.labels.iter().zip(&values[start..]) {
                            if *value != 0.0
                                && let Ok(entry) = identities.labels[entries.clone()].binary_search(label)
                            {
                                mass[entry] += value;
                            }
                        }
                    }
                    let total: f32 = mass.iter().sum();
                    if total != 0.0 {
                        let calibrated = entries.zip(&mass);
                        found.extend(
                            calibrated.map(|(entry, mass)| (entry, mass - tape.probabilities[entry] * total)),
                        );
                    }
                }
                found
            })
            .collect();
        for (entry, value) in chunks.into_iter().flatten() {
            gradients.log_calibrations[entry] -= value;
        }
    }
}

/// Makes gradients of posed Gaussians zero, in the parameters that are moved; others have none. Colours that do not move keep
/// what they have, which nothing reads; memory that fits stays.
fn reset(v: &mut Gaussians, field: &Field, is_moved: impl Fn(&Parameter) -> bool) {
    let n = field.gaussians.len();
    let fits = |(parameter, values): (Parameter, &[f32])| {
        values.len() == if is_moved(&parameter) { n * parameter.width() } else { 0 }
    };
    if !v.tensors().into_iter().all(fits) {
        *v = Gaussians::zeros_of(n, is_moved);
        return;
    }
    let colors = v.sh_coefficients.par_iter_mut().with_min_len(CHUNK).enumerate();
    colors.filter(|(row, _)| has_posed_colors(field, *row)).for_each(|(_, v)| v.fill(0.0));
    for (_, values) in v.tensors_mut().into_iter().filter(|(parameter, _)| *parameter != SH_COEFFICIENTS) {
        values.par_chunks_mut(64 * CHUNK).for_each(|values| values.fill(0.0));
    }
}

/// Gradients of the colour loss by the colours of a tile's pixels.
fn tile_cotangents(place: &TilePlace, v_color: &[[f32; 3]], color: &[[f32; 3]]) -> TileCotangents {
    let zero = [[0.0; LANES]; GROUPS];
    let mut cotangents = TileCotangents { color: [zero; 3], alpha: None, remainder: zero };
    for group in 0..GROUPS {
        for lane in 0..LANES {
            if let Some(pixel) = place.pixel(group, lane) {
                let (v, c) = (v_color[pixel], color[pixel]);
                for channel in 0..3 {
                    cotangents.color[channel][group][lane] = v[channel];
                }
                cotangents.remainder[group][lane] = v[0] * c[0] + v[1] * c[1] + v[2] * c[2];
            }
        }
    }
    cotangents
}

/// Adds gradients by the coverage of a tile's pixels, given what light they still let through.
fn add_alpha(
    cotangents: &mut TileCotangents,
    place: &TilePlace,
    v_alpha: &[f32],
    transmittance: &TilePixels,
) {
    let mut alpha = Box::new([[0.0; LANES]; GROUPS]);
    for group in 0..GROUPS {
        for lane in 0..LANES {
            if let Some(pixel) = place.pixel(group, lane) {
                alpha[group][lane] = v_alpha[pixel];
                cotangents.remainder[group][lane] += v_alpha[pixel] * (1.0 - transmittance[group][lane]);
            }
        }
    }
    cotangents.alpha = Some(alpha);
}

/// 1 / M_y where it carries a gradient, and `S_end / A` under coverage normalisation.
fn instance_cotangents(
    labels: &TileLabels,
    image: &TileImage,
    settings: &RenderSettings,
) -> (TilePixels, Option<Box<TilePixels>>) {
    let normalised = settings.instances.is_some_and(|i| i.normalisation == InstanceNormalisation::Coverage);
    let mut inverse_probability = [[0.0; LANES]; GROUPS];
    let mut coverage_ratio = normalised.then(|| Box::new([[0.0; LANES]; GROUPS]));
    for group in 0..GROUPS {
        for lane in labels.labelled_lanes(group) {
            let probability = image.label_probability[group][lane];
            if probability < MIN_LABEL_PROBABILITY {
                continue;
            }
            inverse_probability[group][lane] = 1.0 / probability;
            if let Some(ratio) = &mut coverage_ratio {
                let rest = image.instance_transmittance[group][lane];
                ratio[group][lane] = rest / (1.0 - rest).max(MIN_LABEL_PROBABILITY);
            }
        }
    }
    (inverse_probability, coverage_ratio)
}
