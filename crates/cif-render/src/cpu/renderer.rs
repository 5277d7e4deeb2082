//! Strings the stages together.

use cif_field::tracks::{GaussiansMut, TracksAtTime};
use cif_field::{Deformation, Field, Gaussians, Identities};
use cif_geometry::{PinholeCamera, PixelGrid};
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::bin::{TileLists, sort_by_depth};
use super::deform::{DeformationAtTime, PosedArrayGradients, PosedArrays};
use super::dense::{InstanceTile, instance_tile};
use super::identity::label_mass_tile;
use super::project::{Posed, PosedGradient, Splat, SplatGradient, ViewConstants, project, project_backward};
use super::rasterize::{
    GROUPS, IdentityRows, TileImage, TileLabels, TilePixels, TilePlace, pixel_in_tile, rasterize_tile,
};
use super::rasterize_backward::{TileCotangents, TileInstances, rasterize_tile_backward};
use super::timing::{StageTimes, timed};
use super::vector::LANES;
use crate::constants::{MIN_COVERAGE, MIN_LABEL_PROBABILITY};
use crate::image::InstanceImage;
use crate::{Channels, Gradients, InstanceNormalisation, RenderSettings, RenderedImage};

/// Gaussians handled by one task.
const CHUNK: usize = 512;

/// Rank of Gaussians that are not visible.
const NOT_VISIBLE: u32 = u32::MAX;

/// Which vector instructions to use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SimdLevel {
    /// The widest the processor has.
    #[default]
    Auto,
    /// Baseline instructions of the target only.
    Portable,
}

/// Counts of one view, for cost tables.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewStatistics {
    /// Gaussians with a non-empty footprint in the view.
    pub visible: usize,
    /// (tile, Gaussian) pairs.
    pub tile_pairs: usize,
    /// (pixel, Gaussian) pairs whose footprint was evaluated in the forward pass.
    pub evaluated_pairs: u64,
    /// Gaussians whose deformation was differentiated in the last backward pass.
    pub deformed_backward: usize,
}

/// What the forward pass of a training view returns.
#[derive(Clone, Debug)]
pub struct ForwardPass {
    /// Rendered colour on the background.
    pub color: PixelGrid<[f32; 3]>,
    /// Mean over labelled pixels of the instance loss; 0 without labelled pixels.
    pub instance_loss: f64,
    /// Labelled pixels of the view.
    pub labelled_pixels: usize,
    /// Labelled pixels whose label no covering Gaussian supports (methods reference 4.4).
    pub unsupported_pixels: usize,
    /// Counts.
    pub statistics: ViewStatistics,
}

/// Colour-weighted label mass per Gaussian (methods reference 5.1); add views, then normalise.
#[derive(Clone, Debug, PartialEq)]
pub struct IdentityCounts {
    /// Number of instances K.
    pub instances: usize,
    /// Mass n_i^k, `[N, K]`, over labelled pixels.
    pub label_mass: Vec<f64>,
    /// Mass d_i over all pixels used, `[N]`.
    pub total_mass: Vec<f64>,
}

impl IdentityCounts {
    /// No mass yet for N Gaussians and K instances.
    #[must_use]
    pub fn zeros(gaussians: usize, instances: usize) -> Self {
        Self { instances, label_mass: vec![0.0; gaussians * instances], total_mass: vec![0.0; gaussians] }
    }
}

/// State of the last forward pass that the backward pass needs.
#[derive(Default)]
struct Tape {
    view: Option<(ViewConstants, RenderSettings, f64)>,
    posed: PosedArrays,
    splats: Vec<Splat>,
    lists: TileLists,
    tiles: Vec<TileImage>,
    labels: Vec<Option<TileLabels>>,
    probabilities: Vec<f32>,
    color: Vec<[f32; 3]>,
    labelled_pixels: usize,
}

/// Renders views; keeps scratch memory between calls. Threads come from the current rayon pool.
pub struct Renderer {
    level: Level,
    times: StageTimes,
    statistics: ViewStatistics,
    tape: Tape,
}

impl std::fmt::Debug for Renderer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Renderer")
            .field("level", &self.level)
            .field("times", &self.times)
            .finish_non_exhaustive()
    }
}

impl Renderer {
    /// A renderer with the given instructions.
    #[must_use]
    pub fn new(simd: SimdLevel) -> Self {
        let level = match simd {
            SimdLevel::Auto => Level::new(),
            SimdLevel::Portable => Level::baseline(),
        };
        Self {
            level,
            times: StageTimes::default(),
            statistics: ViewStatistics::default(),
            tape: Tape::default(),
        }
    }

    /// Name of the vector instructions in use.
    #[must_use]
    pub fn simd_name(&self) -> String {
        let name = format!("{:?}", self.level);
        name.split(['(', ' ']).next().unwrap_or_default().to_owned()
    }

    /// Wall time per stage since the last [`Self::reset_times`].
    #[must_use]
    pub fn times(&self) -> StageTimes {
        self.times
    }

    /// Sets the stage times to zero.
    pub fn reset_times(&mut self) {
        self.times = StageTimes::default();
    }

    /// Counts of the last view.
    #[must_use]
    pub fn statistics(&self) -> ViewStatistics {
        self.statistics
    }

    /// Renders a view for looking at or measuring.
    pub fn render(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
    ) -> RenderedImage {
        let wants_instances = channels.instances && field.identities.is_some();
        let settings = RenderSettings {
            instances: if wants_instances { settings.instances.or(Some(Default::default())) } else { None },
            ..*settings
        };
        self.prepare(field, camera, time, &settings);
        self.rasterize(None, channels.depth);
        let (width, height) = (camera.width, camera.height);
        let alpha =
            self.gather_image(width, height, |tile, group, lane| 1.0 - tile.transmittance[group][lane]);
        let depth = channels.depth.then(|| {
            self.gather_image(width, height, |tile, group, lane| {
                let coverage = 1.0 - tile.transmittance[group][lane];
                if coverage > MIN_COVERAGE { tile.depth[group][lane] / coverage } else { 0.0 }
            })
        });
        let instances = match (&field.identities, wants_instances) {
            (Some(identities), true) => Some(self.render_instances(identities, width, height)),
            _ => None,
        };
        let color = PixelGrid::from_pixels(width, height, std::mem::take(&mut self.tape.color));
        RenderedImage { color, alpha, depth, instances }
    }

    /// Forward pass of a training view; keeps on the renderer what [`Self::backward`] needs. `labels` hold
    /// dense index + 1, 0 = unlabelled; they are read only when `settings.instances` is set.
    ///
    /// # Panics
    /// When `labels` and camera differ in size, or instances are asked of a field without identities.
    pub fn forward(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        labels: Option<&PixelGrid<u16>>,
    ) -> ForwardPass {
        let labels = labels.filter(|_| settings.instances.is_some());
        if let Some(labels) = labels {
            assert_eq!((labels.width, labels.height), (camera.width, camera.height), "label map size");
        }
        self.prepare(field, camera, time, settings);
        let identities = labels.map(|labels| {
            (labels, field.identities.as_ref().expect("the instance pass needs estimated identities"))
        });
        self.rasterize(identities, false);
        let (instance_loss, unsupported_pixels) = self.instance_loss(settings);
        ForwardPass {
            color: PixelGrid::from_pixels(camera.width, camera.height, self.tape.color.clone()),
            instance_loss,
            labelled_pixels: self.tape.labelled_pixels,
            unsupported_pixels,
            statistics: self.statistics,
        }
    }

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
        let (view, settings, time) = self.tape.view.expect("backward follows a forward pass");
        assert!(field.tracks.is_none(), "recorded motion has no gradients: trainers refuse such fields");
        assert_eq!((v_color.width, v_color.height), (view.width, view.height), "cotangent size");
        let mut times = self.times;
        let (pairs, label_mass, label_offsets) = timed(&mut times.rasterize_backward, || {
            self.rasterize_backward(field, v_color, instance_weight, &settings)
        });

        let n = field.gaussians.len();
        let deformation =
            field.deformation.as_ref().filter(|_| settings.deform).map(|d| DeformationAtTime::new(d, time));
        let mut v_posed = PosedArrayGradients::default();
        timed(&mut times.project_backward, || {
            self.project_backward(field, &view, &pairs, gradients, &mut v_posed);
            self.calibration_backward(field, &label_mass, &label_offsets, gradients);
        });
        if let Some(deformation) = deformation {
            timed(&mut times.deform_backward, || {
                let active: Vec<u32> = (0..n as u32)
                    .filter(|&row| {
                        let row = row as usize;
                        v_posed.means[row] != [0.0; 3]
                            || v_posed.log_scales[row] != [0.0; 3]
                            || v_posed.quaternions[row] != [0.0; 4]
                            || v_posed.opacity_logits[row] != 0.0
                            || v_posed.sh_coefficients.get(row).is_some_and(|sh| sh.iter().any(|v| *v != 0.0))
                    })
                    .collect();
                self.statistics.deformed_backward = active.len();
                deformation.backward(
                    self.level,
                    &field.gaussians,
                    &active,
                    &v_posed,
                    &mut gradients.planes,
                    &mut gradients.mlp,
                    &mut gradients.gaussians.means,
                );
            });
        }
        self.times = times;
    }

    /// Adds a view's colour-weighted label mass to `counts`.
    pub fn count_identities(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        labels: &PixelGrid<u16>,
        counts: &mut IdentityCounts,
    ) {
        let settings = RenderSettings { instances: None, ..*settings };
        self.prepare(field, camera, time, &settings);
        self.rasterize(None, false);
        let Tape { splats, lists, tiles, .. } = &self.tape;
        let level = self.level;
        let masses: Vec<(Option<TileLabels>, Vec<f32>)> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let place = self.place(tile);
                let tile_labels = tile_labels(labels, &place);
                let columns = tile_labels.as_ref().map_or(0, |labels| labels.labels.len()) + 1;
                let ranks = lists.tile(tile);
                let mut mass = vec![0.0; ranks.len() * columns];
                dispatch!(level, simd => label_mass_tile(
                    simd, splats, ranks, &place, tile_labels.as_ref(), &tiles[tile], &mut mass));
                (tile_labels, mass)
            })
            .collect();
        for (tile, (tile_labels, mass)) in masses.iter().enumerate() {
            let labels = tile_labels.as_ref().map_or(&[][..], |labels| &labels.labels);
            for (rank, row) in lists.tile(tile).iter().zip(mass.chunks_exact(labels.len() + 1)) {
                let gaussian = splats[*rank as usize].gaussian as usize;
                counts.total_mass[gaussian] += f64::from(row[labels.len()]);
                for (label, mass) in labels.iter().zip(row) {
                    counts.label_mass[gaussian * counts.instances + *label as usize] += f64::from(*mass);
                }
            }
        }
    }

    /// The canonical Gaussians moved to a time: every array in raw form, deltas added (methods reference 2.3),
    /// then moved by their tracks.
    pub fn deform(&mut self, field: &Field, time: f64) -> Gaussians {
        self.posed_gaussians(field, field.tracks.as_ref().map(|tracks| tracks.at(time)), time)
    }

    /// As [`Self::deform`], with what is hidden at the time as if it were not.
    pub fn deform_unhidden(&mut self, field: &Field, time: f64) -> Gaussians {
        let tracks = field.tracks.as_ref().map(|tracks| tracks.at(time).unhidden());
        self.posed_gaussians(field, tracks, time)
    }

    fn posed_gaussians(&mut self, field: &Field, tracks: Option<TracksAtTime<'_>>, time: f64) -> Gaussians {
        let mut posed = PosedArrays::default();
        pose(self.level, field, field.deformation.as_ref(), tracks, time, &mut posed);
        let canonical = &field.gaussians;
        fn or<T: Clone>(moved: Vec<T>, canonical: &[T]) -> Vec<T> {
            if moved.is_empty() { canonical.to_vec() } else { moved }
        }
        Gaussians {
            means: or(posed.means, &canonical.means),
            log_scales: or(posed.log_scales, &canonical.log_scales),
            quaternions: or(posed.quaternions, &canonical.quaternions),
            opacity_logits: or(posed.opacity_logits, &canonical.opacity_logits),
            occupancy_logits: or(posed.occupancy_logits, &canonical.occupancy_logits),
            sh_coefficients: or(posed.sh_coefficients, &canonical.sh_coefficients),
        }
    }

    /// Deformation, projection, sorting and tile lists of a view.
    fn prepare(&mut self, field: &Field, camera: &PinholeCamera, time: f64, settings: &RenderSettings) {
        let mut times = self.times;
        let level = self.level;
        let tape = &mut self.tape;
        let view = ViewConstants::new(camera, settings);
        tape.view = Some((view, *settings, time));
        timed(&mut times.deform, || {
            let deformation = field.deformation.as_ref().filter(|_| settings.deform);
            let tracks = field.tracks.as_ref().map(|tracks| tracks.at(time));
            pose(level, field, deformation, tracks, time, &mut tape.posed);
        });
        timed(&mut times.project, || {
            let posed = PosedView::new(&field.gaussians, &tape.posed);
            let n = field.gaussians.len();
            let chunks: Vec<Vec<Splat>> = (0..n.div_ceil(CHUNK))
                .into_par_iter()
                .map(|chunk| {
                    let rows = chunk * CHUNK..n.min((chunk + 1) * CHUNK);
                    dispatch!(level, _simd => rows
                        .filter_map(|row| project(&view, &posed.at(row), row as u32))
                        .collect())
                })
                .collect();
            tape.splats.clear();
            for chunk in &chunks {
                tape.splats.extend_from_slice(chunk);
            }
        });
        timed(&mut times.bin, || {
            sort_by_depth(&mut tape.splats);
            tape.lists.build(&tape.splats, camera.width, camera.height);
        });
        self.statistics = ViewStatistics {
            visible: tape.splats.len(),
            tile_pairs: tape.lists.ranks.len(),
            ..ViewStatistics::default()
        };
        self.times = times;
    }

    fn place(&self, tile: usize) -> TilePlace {
        let (view, ..) = self.tape.view.as_ref().expect("a view was prepared");
        let (x, y) = self.tape.lists.origin(tile);
        TilePlace { x, y, width: view.width, height: view.height }
    }

    /// Blends all tiles into the tape.
    fn rasterize(&mut self, labels: Option<(&PixelGrid<u16>, &Identities)>, depth: bool) {
        let mut times = self.times;
        timed(&mut times.rasterize, || {
            let level = self.level;
            let tiles = self.tape.lists.tiles();
            self.tape.probabilities = labels.map(|(_, rows)| rows.probabilities()).unwrap_or_default();
            self.tape.labels = match labels {
                Some((map, _)) => {
                    (0..tiles).into_par_iter().map(|tile| tile_labels(map, &self.place(tile))).collect()
                }
                None => vec![None; tiles],
            };
            self.tape.labelled_pixels =
                labels.map_or(0, |(map, _)| map.pixels.iter().filter(|label| **label != 0).count());
            let mut images = std::mem::take(&mut self.tape.tiles);
            images.resize_with(tiles, TileImage::default);
            let rows = labels.map(|(_, rows)| identity_rows(rows, &self.tape.probabilities));
            let (splats, lists) = (&self.tape.splats, &self.tape.lists);
            images.par_iter_mut().enumerate().for_each(|(tile, image)| {
                let place = self.place(tile);
                let ranks = lists.tile(tile);
                let labels = self.tape.labels[tile].as_ref().zip(rows);
                dispatch!(level, simd => match (labels.is_some(), depth) {
                    (true, _) => rasterize_tile::<_, true, false>(simd, splats, ranks, &place, labels, image),
                    (false, true) => rasterize_tile::<_, false, true>(simd, splats, ranks, &place, None, image),
                    (false, false) => rasterize_tile::<_, false, false>(simd, splats, ranks, &place, None, image),
                });
            });
            self.tape.tiles = images;
            self.statistics.evaluated_pairs = self.tape.tiles.iter().map(|tile| tile.evaluated).sum();
            let (view, settings, _) = self.tape.view.expect("a view was prepared");
            let background = settings.background;
            self.tape.color = self
                .gather_image(view.width, view.height, |tile, group, lane| {
                    let t = tile.transmittance[group][lane];
                    [0, 1, 2].map(|channel| tile.color[channel][group][lane] + t * background[channel])
                })
                .pixels;
        });
        self.times = times;
    }

    /// A row-major image from the blended tiles.
    fn gather_image<T: Copy + Default + Send>(
        &self,
        width: u32,
        height: u32,
        value: impl Fn(&TileImage, usize, usize) -> T + Sync,
    ) -> PixelGrid<T> {
        gather_tiles(&self.tape.lists, width, height, |tile, group, lane| {
            value(&self.tape.tiles[tile], group, lane)
        })
    }

    fn render_instances(&self, identities: &Identities, width: u32, height: u32) -> InstanceImage {
        let probabilities = identities.probabilities();
        let rows = identity_rows(identities, &probabilities);
        let labelled_shares = identities.labelled_shares();
        let lists = &self.tape.lists;
        let level = self.level;
        let tiles: Vec<InstanceTile> = (0..lists.tiles())
            .into_par_iter()
            .map(|tile| {
                let mut image = InstanceTile::default();
                let place = self.place(tile);
                dispatch!(level, simd => instance_tile(
                    simd, &self.tape.splats, lists.tile(tile), &place, rows, &labelled_shares, &mut image));
                image
            })
            .collect();
        InstanceImage {
            label: gather_tiles(lists, width, height, |tile, group, lane| tiles[tile].label[group][lane]),
            probability: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].probability[group][lane]
            }),
            coverage: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].coverage[group][lane]
            }),
            foreground: gather_tiles(lists, width, height, |tile, group, lane| {
                tiles[tile].foreground[group][lane]
            }),
            entropy: gather_tiles(lists, width, height, |tile, group, lane| tiles[tile].entropy[group][lane]),
        }
    }

    /// Mean loss over labelled pixels, and how many of them no covering Gaussian supports.
    fn instance_loss(&self, settings: &RenderSettings) -> (f64, usize) {
        let Some(instances) = settings.instances else { return (0.0, 0) };
        let (mut loss, mut unsupported) = (0.0_f64, 0);
        for (tile, labels) in self.tape.tiles.iter().zip(&self.tape.labels) {
            let Some(labels) = labels else { continue };
            for group in 0..GROUPS {
                for lane in (0..LANES).filter(|lane| labels.labelled[group] >> lane & 1 == 1) {
                    let probability = tile.label_probability[group][lane];
                    let shown = f64::from(probability.max(MIN_LABEL_PROBABILITY));
                    loss -= shown.ln();
                    if probability < MIN_LABEL_PROBABILITY {
                        unsupported += 1;
                    } else if instances.normalisation == InstanceNormalisation::Coverage {
                        loss += f64::from(1.0 - tile.instance_transmittance[group][lane]).ln();
                    }
                }
            }
        }
        (loss / self.tape.labelled_pixels.max(1) as f64, unsupported)
    }

    /// Per (tile, splat) gradients, label masses, and where each tile's masses begin.
    fn rasterize_backward(
        &self,
        field: &Field,
        v_color: &PixelGrid<[f32; 3]>,
        instance_weight: f32,
        settings: &RenderSettings,
    ) -> (Vec<SplatGradient>, Vec<f32>, Vec<usize>) {
        let tape = &self.tape;
        let lists = &tape.lists;
        let trains_instances = instance_weight != 0.0 && tape.labelled_pixels > 0;
        let pixel_weight = instance_weight / tape.labelled_pixels.max(1) as f32;
        let rows = field.identities.as_ref().map(|rows| identity_rows(rows, &tape.probabilities));
        let mut label_offsets = vec![0_usize];
        for tile in 0..lists.tiles() {
            let slots = match &tape.labels[tile] {
                Some(labels) if trains_instances => labels.labels.len(),
                _ => 0,
            };
            label_offsets.push(label_offsets[tile] + slots * lists.tile(tile).len());
        }
        let mut pairs = vec![SplatGradient::default(); lists.ranks.len()];
        let mut label_mass = vec![0.0_f32; label_offsets[lists.tiles()]];
        let mut tasks = Vec::with_capacity(lists.tiles());
        let (mut pair_rest, mut mass_rest) = (&mut pairs[..], &mut label_mass[..]);
        for tile in 0..lists.tiles() {
            let (pairs, rest) = pair_rest.split_at_mut(lists.tile(tile).len());
            pair_rest = rest;
            let (mass, rest) = mass_rest.split_at_mut(label_offsets[tile + 1] - label_offsets[tile]);
            mass_rest = rest;
            tasks.push((tile, pairs, mass));
        }
        let level = self.level;
        tasks.into_par_iter().for_each(|(tile, pairs, mass)| {
            if pairs.is_empty() {
                return;
            }
            let place = self.place(tile);
            let image = &tape.tiles[tile];
            let mut cotangents = TileCotangents {
                color: [[[0.0; LANES]; GROUPS]; 3],
                remainder: [[0.0; LANES]; GROUPS],
                weight_over_probability: [[0.0; LANES]; GROUPS],
                weight: [[0.0; LANES]; GROUPS],
                coverage_ratio: [[0.0; LANES]; GROUPS],
            };
            for group in 0..GROUPS {
                for lane in 0..LANES {
                    let (column, row) = pixel_in_tile(group, lane);
                    let (x, y) = (place.x + column, place.y + row);
                    if x < place.width && y < place.height {
                        let pixel = y as usize * place.width as usize + x as usize;
                        let (v, c) = (v_color.pixels[pixel], tape.color[pixel]);
                        for channel in 0..3 {
                            cotangents.color[channel][group][lane] = v[channel];
                        }
                        cotangents.remainder[group][lane] = v[0] * c[0] + v[1] * c[1] + v[2] * c[2];
                    }
                }
            }
            let labels = tape.labels[tile].as_ref().filter(|_| trains_instances);
            if let Some(labels) = labels {
                let normalised =
                    settings.instances.is_some_and(|i| i.normalisation == InstanceNormalisation::Coverage);
                set_instance_cotangents(labels, image, pixel_weight, normalised, &mut cotangents);
            }
            let ranks = lists.tile(tile);
            let instances = labels.zip(rows).map(|(labels, rows)| TileInstances {
                labels,
                rows,
                geometry: settings.instances.unwrap_or_default().geometry,
            });
            dispatch!(level, simd => if instances.is_some() {
                rasterize_tile_backward::<_, true>(
                    simd, &tape.splats, ranks, &place, &mut cotangents, instances.as_ref(), pairs, mass);
            } else {
                rasterize_tile_backward::<_, false>(
                    simd, &tape.splats, ranks, &place, &mut cotangents, None, pairs, mass);
            });
        });
        (pairs, label_mass, label_offsets)
    }

    /// Sums each splat's pairs and carries them to the raw parameters.
    fn project_backward(
        &self,
        field: &Field,
        view: &ViewConstants,
        pairs: &[SplatGradient],
        gradients: &mut Gradients,
        v_posed: &mut PosedArrayGradients,
    ) {
        let tape = &self.tape;
        let n = field.gaussians.len();
        let mut rank_of = vec![NOT_VISIBLE; n];
        for (rank, splat) in tape.splats.iter().enumerate() {
            rank_of[splat.gaussian as usize] = rank as u32;
        }
        let posed = PosedView::new(&field.gaussians, &tape.posed);
        let moves_sh = !tape.posed.sh_coefficients.is_empty();
        v_posed.means = vec![[0.0; 3]; n];
        v_posed.log_scales = vec![[0.0; 3]; n];
        v_posed.quaternions = vec![[0.0; 4]; n];
        v_posed.opacity_logits = vec![0.0; n];
        let mut v_sh = Vec::new();
        if moves_sh {
            v_sh = vec![[0.0; cif_field::gaussians::SH_FLOATS]; n];
        }
        let half = [view.width as f32 / 2.0, view.height as f32 / 2.0];
        let out = &mut gradients.gaussians;
        let sh = if moves_sh { &mut v_sh } else { &mut out.sh_coefficients };
        let level = self.level;
        out.means
            .par_chunks_mut(CHUNK)
            .zip(out.log_scales.par_chunks_mut(CHUNK))
            .zip(out.quaternions.par_chunks_mut(CHUNK))
            .zip(out.opacity_logits.par_chunks_mut(CHUNK))
            .zip(out.occupancy_logits.par_chunks_mut(CHUNK))
            .zip(sh.par_chunks_mut(CHUNK))
            .zip(gradients.screen.par_chunks_mut(CHUNK))
            .zip(gradients.radii.par_chunks_mut(CHUNK))
            .zip(v_posed.means.par_chunks_mut(CHUNK))
            .zip(v_posed.log_scales.par_chunks_mut(CHUNK))
            .zip(v_posed.quaternions.par_chunks_mut(CHUNK))
            .zip(v_posed.opacity_logits.par_chunks_mut(CHUNK))
            .enumerate()
            .for_each(|(chunk, rows)| {
                let (rows, v_opacities) = rows;
                let (rows, v_quaternions) = rows;
                let (rows, v_log_scales) = rows;
                let (rows, v_means) = rows;
                let (rows, radii) = rows;
                let (rows, screen) = rows;
                let (rows, sh) = rows;
                let (rows, occupancies) = rows;
                let (rows, opacities) = rows;
                let (rows, quaternions) = rows;
                let (means, log_scales) = rows;
                dispatch!(level, _simd => for row in 0..means.len() {
                    let gaussian = chunk * CHUNK + row;
                    let rank = rank_of[gaussian];
                    if rank == NOT_VISIBLE {
                        continue;
                    }
                    let splat = &tape.splats[rank as usize];
                    radii[row] = splat.radius.max(radii[row]);
                    let mut v = SplatGradient::default();
                    for &pair in tape.lists.pairs_of(rank as usize) {
                        v.add(&pairs[pair as usize]);
                    }
                    if v == SplatGradient::default() {
                        continue;
                    }
                    let PosedGradient { mean, log_scale, quaternion, opacity_logit, occupancy_logit } =
                        project_backward(view, &posed.at(gaussian), splat, &v, &mut sh[row]);
                    for axis in 0..2 {
                        screen[row][axis] += half[axis] * v.mean[axis];
                    }
                    for axis in 0..3 {
                        means[row][axis] += mean[axis];
                        log_scales[row][axis] += log_scale[axis];
                    }
                    for axis in 0..4 {
                        quaternions[row][axis] += quaternion[axis];
                    }
                    opacities[row] += opacity_logit;
                    occupancies[row] += occupancy_logit;
                    v_means[row] = mean;
                    v_log_scales[row] = log_scale;
                    v_quaternions[row] = quaternion;
                    v_opacities[row] = opacity_logit;
                });
            });
        if moves_sh {
            for (total, v) in out.sh_coefficients.as_flattened_mut().iter_mut().zip(v_sh.as_flattened()) {
                *total += v;
            }
            v_posed.sh_coefficients = v_sh;
        }
    }

    /// `v_mu_i^k = -(rho_i^k - p_i^k R_i)` (methods reference 4.2).
    fn calibration_backward(
        &self,
        field: &Field,
        label_mass: &[f32],
        label_offsets: &[usize],
        gradients: &mut Gradients,
    ) {
        let Some(identities) = field.identities.as_ref().filter(|_| !label_mass.is_empty()) else { return };
        let tape = &self.tape;
        let mut tile_of_pair = vec![0_u32; tape.lists.ranks.len()];
        for tile in 0..tape.lists.tiles() {
            let range = tape.lists.tile_offsets[tile] as usize..tape.lists.tile_offsets[tile + 1] as usize;
            tile_of_pair[range].fill(tile as u32);
        }
        let mut mass = Vec::new();
        for (rank, splat) in tape.splats.iter().enumerate() {
            let entries = identities.range(splat.gaussian as usize);
            mass.clear();
            mass.resize(entries.len(), 0.0_f32);
            for &pair in tape.lists.pairs_of(rank) {
                let tile = tile_of_pair[pair as usize] as usize;
                if label_offsets[tile + 1] == label_offsets[tile] {
                    continue;
                }
                let Some(labels) = &tape.labels[tile] else { continue };
                let local = pair as usize - tape.lists.tile_offsets[tile] as usize;
                let start = label_offsets[tile] + local * labels.labels.len();
                for (label, value) in labels.labels.iter().zip(&label_mass[start..]) {
                    if *value != 0.0
                        && let Ok(entry) = identities.labels[entries.clone()].binary_search(label)
                    {
                        mass[entry] += value;
                    }
                }
            }
            let total: f32 = mass.iter().sum();
            if total != 0.0 {
                for (entry, mass) in entries.zip(&mass) {
                    gradients.log_calibrations[entry] -= mass - tape.probabilities[entry] * total;
                }
            }
        }
    }
}

impl SplatGradient {
    fn add(&mut self, other: &Self) {
        for axis in 0..2 {
            self.mean[axis] += other.mean[axis];
        }
        for k in 0..3 {
            self.conic[k] += other.conic[k];
            self.color[k] += other.color[k];
        }
        self.opacity += other.opacity;
        self.responsibility += other.responsibility;
    }
}

/// The one place where Gaussians are moved to a time: learned deltas, then tracks. Arrays that nothing moves
/// are left empty.
fn pose(
    level: Level,
    field: &Field,
    deformation: Option<&Deformation>,
    tracks: Option<TracksAtTime<'_>>,
    time: f64,
    posed: &mut PosedArrays,
) {
    let canonical = &field.gaussians;
    match deformation {
        Some(deformation) => DeformationAtTime::new(deformation, time).forward(level, canonical, posed),
        None => *posed = PosedArrays::default(),
    }
    posed.occupancy_logits.clear();
    let Some(tracks) = tracks.filter(TracksAtTime::changes_anything) else { return };
    if deformation.is_none() {
        posed.means.clone_from(&canonical.means);
        posed.log_scales.clone_from(&canonical.log_scales);
        posed.quaternions.clone_from(&canonical.quaternions);
        posed.opacity_logits.clone_from(&canonical.opacity_logits);
    }
    posed.occupancy_logits.clone_from(&canonical.occupancy_logits);
    if posed.sh_coefficients.is_empty() && tracks.changes_sh() {
        posed.sh_coefficients.clone_from(&canonical.sh_coefficients);
    }
    let moved = GaussiansMut {
        means: &mut posed.means,
        log_scales: &mut posed.log_scales,
        quaternions: &mut posed.quaternions,
        opacity_logits: &mut posed.opacity_logits,
        occupancy_logits: &mut posed.occupancy_logits,
        sh_coefficients: &mut posed.sh_coefficients,
    };
    tracks.apply(canonical, moved);
}

/// Posed parameters by row, falling back to the canonical ones where nothing moves.
struct PosedView<'a> {
    canonical: &'a Gaussians,
    moved: &'a PosedArrays,
}

impl<'a> PosedView<'a> {
    fn new(canonical: &'a Gaussians, moved: &'a PosedArrays) -> Self {
        Self { canonical, moved }
    }

    #[inline(always)]
    fn at(&self, row: usize) -> Posed<'a> {
        let (canonical, moved) = (self.canonical, self.moved);
        let occupancy_logit = *moved.occupancy_logits.get(row).unwrap_or(&canonical.occupancy_logits[row]);
        let sh = moved.sh_coefficients.get(row).unwrap_or(&canonical.sh_coefficients[row]);
        if moved.means.is_empty() {
            Posed {
                mean: canonical.means[row],
                log_scale: canonical.log_scales[row],
                quaternion: canonical.quaternions[row],
                opacity_logit: canonical.opacity_logits[row],
                occupancy_logit,
                sh,
            }
        } else {
            Posed {
                mean: moved.means[row],
                log_scale: moved.log_scales[row],
                quaternion: moved.quaternions[row],
                opacity_logit: moved.opacity_logits[row],
                occupancy_logit,
                sh,
            }
        }
    }
}

fn identity_rows<'a>(identities: &'a Identities, probabilities: &'a [f32]) -> IdentityRows<'a> {
    IdentityRows { row_offsets: &identities.row_offsets, labels: &identities.labels, probabilities }
}

fn tile_labels(map: &PixelGrid<u16>, place: &TilePlace) -> Option<TileLabels> {
    TileLabels::new(|group, lane| {
        let (column, row) = pixel_in_tile(group, lane);
        let (x, y) = (place.x + column, place.y + row);
        if x < place.width && y < place.height { *map.at(x, y) } else { 0 }
    })
}

fn set_instance_cotangents(
    labels: &TileLabels,
    image: &TileImage,
    pixel_weight: f32,
    normalised: bool,
    cotangents: &mut TileCotangents,
) {
    for group in 0..GROUPS {
        for lane in (0..LANES).filter(|lane| labels.labelled[group] >> lane & 1 == 1) {
            let probability = image.label_probability[group][lane];
            if probability < MIN_LABEL_PROBABILITY {
                continue;
            }
            cotangents.weight[group][lane] = pixel_weight;
            cotangents.weight_over_probability[group][lane] = pixel_weight / probability;
            if normalised {
                let rest = image.instance_transmittance[group][lane];
                cotangents.coverage_ratio[group][lane] = rest / (1.0 - rest).max(MIN_LABEL_PROBABILITY);
            }
        }
    }
}

/// A row-major image from per-tile values.
fn gather_tiles<T: Copy + Default + Send>(
    lists: &TileLists,
    width: u32,
    height: u32,
    value: impl Fn(usize, usize, usize) -> T + Sync,
) -> PixelGrid<T> {
    let mut image = PixelGrid::filled(width, height, T::default());
    let band = super::rasterize::ROWS * width as usize;
    if band > 0 {
        image.pixels.par_chunks_mut(band).enumerate().for_each(|(tile_row, band)| {
            for tile_column in 0..lists.columns as usize {
                let tile = tile_row * lists.columns as usize + tile_column;
                let (x0, _) = lists.origin(tile);
                for group in 0..GROUPS {
                    for lane in 0..LANES {
                        let (column, row) = pixel_in_tile(group, lane);
                        let x = (x0 + column) as usize;
                        let pixel = row as usize * width as usize + x;
                        if x < width as usize && pixel < band.len() {
                            band[pixel] = value(tile, group, lane);
                        }
                    }
                }
            }
        });
    }
    image
}

const _: () = assert!(std::mem::size_of::<TilePixels>() == 1024);
