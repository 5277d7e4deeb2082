//! Renders fields on a GPU. Gaussians are posed on the device; those of fields with groups that do more than move as a
//! whole by the processor.

use cif_field::Field;
use cif_geometry::{PinholeCamera, PixelGrid};

use super::buffers::GpuVec;
use super::deform::GpuDeformation;
use super::device::Gpu;
use super::error::GpuError;
use super::gaussians::{GpuGaussians, PACKED_SH_WORDS, geometry, packed_sh};
use super::identities::DeviceIdentities;
use super::kernel::Commands;
use super::poses::{self, GpuPoses};
use super::rasterizer::{Coefficients, PosedGaussians, PosedInput, Rasterizer, ViewInput};
use crate::constants::{MIN_COVERAGE, TILE};
use crate::cpu::{Renderer, SimdLevel};
use crate::image::InstanceImage;
use crate::{Channels, RenderSettings, RenderedImage};

/// Renders views of one field.
#[derive(Debug)]
pub struct GpuRenderer {
    gpu: Gpu,
    rasterizer: Rasterizer,
    poser: Renderer,
    /// Without spherical harmonics where those are packed.
    canonical: GpuGaussians,
    packed_sh: Option<GpuVec<[u32; PACKED_SH_WORDS]>>,
    deformation: Option<GpuDeformation>,
    /// Groups that move as a whole and do nothing else.
    groups: Option<GpuPoses>,
    /// At the time of the view, where anything moves.
    posed: GpuGaussians,
    identities: Option<DeviceIdentities>,
    band_memory: u64,
}

/// Bytes of the pixels of a band, unless said otherwise: a view of 1920 x 1080 pixels with all channels fits.
const BAND_MEMORY: u64 = 512 << 20;

impl GpuRenderer {
    /// Takes a field to the device.
    ///
    /// # Errors
    /// When the field exceeds what the device binds, with the arithmetic; when the driver rejects the kernels.
    pub fn new(gpu: &Gpu, field: &Field) -> Result<Self, GpuError> {
        Self::with(gpu, field, false)
    }

    /// As [`Self::new`], with spherical harmonics above the constant band in 16-bit floats, see [`packed_sh`]: 104
    /// bytes per Gaussian instead of 192. Colours differ by less than half an 8-bit level. Fields whose spherical
    /// harmonics change with time keep full ones.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn compact(gpu: &Gpu, field: &Field) -> Result<Self, GpuError> {
        Self::with(gpu, field, true)
    }

    fn with(gpu: &Gpu, field: &Field, compact: bool) -> Result<Self, GpuError> {
        let identities = field
            .identities
            .as_ref()
            .map(|identities| DeviceIdentities::from_identities(gpu, identities, field.instances.len()))
            .transpose()?;
        let rigid = field.tracks.as_ref().filter(|tracks| tracks.is_rigid());
        let groups = rigid.map(|tracks| GpuPoses::new(gpu, tracks)).transpose()?;
        let learned = field.deformation.as_ref().filter(|_| field.tracks.is_none() || groups.is_some());
        let mut deformation = learned.map(|deformation| GpuDeformation::new(gpu, deformation)).transpose()?;
        if let (Some(deformation), Some(_)) = (&mut deformation, &groups) {
            deformation.set_still(gpu, &field.left_alone())?;
        }
        let packs = compact
            && gpu.facts().packed_half_floats
            && field.tracks.is_none()
            && !deformation.as_ref().is_some_and(GpuDeformation::moves_sh);
        let gaussians = &field.gaussians;
        let (canonical, packed_sh) = if packs {
            let rows: Vec<_> = gaussians.sh_coefficients.iter().map(packed_sh).collect();
            let mut canonical = GpuGaussians::zeros(gpu, 0)?;
            canonical.geometry.replace(gpu, &geometry(gaussians))?;
            (canonical, Some(GpuVec::from_slice(gpu, "packed spherical harmonics", &rows)?))
        } else {
            (GpuGaussians::upload(gpu, gaussians)?, None)
        };
        Ok(Self {
            rasterizer: Rasterizer::new(gpu)?,
            poser: Renderer::new(SimdLevel::Auto),
            canonical,
            packed_sh,
            deformation,
            groups,
            posed: GpuGaussians::zeros(gpu, 0)?,
            identities,
            band_memory: BAND_MEMORY,
            gpu: gpu.clone(),
        })
    }

    /// True when spherical harmonics are in 16-bit floats.
    #[must_use]
    pub fn is_compact(&self) -> bool {
        self.packed_sh.is_some()
    }

    /// Sets the memory that a band may take in addition to its (tile, Gaussian) pairs, in bytes, on the device and off
    /// it, which decides how many rows are drawn at once. Pictures do not depend on it.
    pub fn set_band_memory(&mut self, bytes: u64) {
        self.band_memory = bytes;
    }

    /// Renders a view for looking at or measuring; `field` is the one that the renderer was made for.
    ///
    /// # Errors
    /// When the view exceeds what the device binds, with the arithmetic; when the device is out of memory or lost.
    pub fn render(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
    ) -> Result<RenderedImage, GpuError> {
        let mut image: Option<RenderedImage> = None;
        self.render_bands(field, camera, time, settings, channels, |_, band| {
            match &mut image {
                None => image = Some(band),
                Some(image) => image.append(band),
            }
            Ok::<(), GpuError>(())
        })?;
        Ok(image.expect("a view has a band"))
    }

    /// Renders a view in bands of rows from top to bottom, and hands each to `take`, with the row that is its first.
    /// Bands whose (tile, Gaussian) pairs the device cannot hold are halved.
    ///
    /// # Errors
    /// When a row of tiles exceeds what the device binds, with the arithmetic; when the device is out of memory or
    /// lost; the first of `take`, which is not called again then.
    pub fn render_bands<E: From<GpuError>>(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        channels: Channels,
        mut take: impl FnMut(u32, RenderedImage) -> Result<(), E>,
    ) -> Result<(), E> {
        let settings = settings.for_outputs(field, channels);
        let rows = camera.height.div_ceil(TILE);
        let row_bytes = u64::from(camera.width * TILE) * pixel_bytes(channels);
        let mut most = (self.band_memory / row_bytes.max(1)).clamp(1, u64::from(rows.max(1))) as u32;
        let mut first = 0;
        while first < rows {
            let count = most.min(rows - first);
            match self.draw_rows(field, camera, time, &settings, channels.depth, [first, count]) {
                Err(GpuError::TooLarge { .. }) if count > 1 => most = count.div_ceil(2),
                Err(error) => return Err(error.into()),
                Ok(band) => {
                    take(first * TILE, band)?;
                    first += count;
                }
            }
        }
        Ok(())
    }

    /// Draws so many rows of tiles from the first on.
    fn draw_rows(
        &mut self,
        field: &Field,
        camera: &PinholeCamera,
        time: f64,
        settings: &RenderSettings,
        with_depth: bool,
        rows: [u32; 2],
    ) -> Result<RenderedImage, GpuError> {
        let input = ViewInput { camera, settings, labels: None };
        let identities = self.identities.as_ref().filter(|_| settings.instances.is_some());
        let mut commands = Commands::new(&self.gpu, None);
        let posed: PosedInput<'_> = if field.tracks.is_some() && self.groups.is_none() {
            let poser = &mut self.poser;
            let moved = if settings.deform || field.deformation.is_none() {
                poser.deform(field, time)
            } else {
                poser.deform(&Field { deformation: None, ..field.clone() }, time)
            };
            self.posed.replace(&self.gpu, &moved)?;
            (&self.posed).into()
        } else {
            let deformation = self.deformation.as_ref().filter(|_| settings.deform);
            if deformation.is_some() || self.groups.is_some() {
                self.posed.geometry.resize(&self.gpu, self.canonical.len())?;
            }
            if deformation.is_some_and(GpuDeformation::moves_sh) {
                self.posed.sh.resize(&self.gpu, self.canonical.len())?;
            }
            let (groups, canonical) = (self.groups.as_ref(), &self.canonical);
            poses::pose(&self.gpu, &mut commands, time, deformation, groups, canonical, &self.posed)
        };
        let (gpu, rasterizer) = (&self.gpu, &mut self.rasterizer);
        let sh = self.packed_sh.as_ref().map_or(posed.coefficients(), Coefficients::Packed);
        rasterizer.project_rows(
            gpu,
            &mut commands,
            PosedGaussians { geometry: posed.geometry, sh },
            identities,
            &input,
            Some(rows),
        )?;
        rasterizer.draw_projected(gpu, commands, identities, with_depth)
    }
}

/// Bytes of a pixel on the device, during the read-back and in the image.
fn pixel_bytes(channels: Channels) -> u64 {
    let four = size_of::<[f32; 4]>();
    let depth = if channels.depth { 2 * four + size_of::<f32>() } else { 0 };
    let instances = if channels.instances { 4 * four + 4 * size_of::<f32>() } else { 0 };
    // Colours and what is blended next to them, then colours during the read-back and in the image.
    (2 * four + 3 * four + depth + instances) as u64
}

impl Rasterizer {
    /// Draws a view for looking at or measuring, after what `commands` hold, and reads it; instances where
    /// `identities` are given. Waits for the device.
    ///
    /// # Errors
    /// When the view exceeds what the device binds, with the arithmetic; when the device is out of memory or lost.
    pub fn draw(
        &mut self,
        gpu: &Gpu,
        mut commands: Commands<'_>,
        posed: PosedInput<'_>,
        identities: Option<&DeviceIdentities>,
        input: &ViewInput<'_>,
        with_depth: bool,
    ) -> Result<RenderedImage, GpuError> {
        self.project(gpu, &mut commands, posed, identities, input)?;
        self.draw_projected(gpu, commands, identities, with_depth)
    }

    /// As [`Self::draw`], of a view whose projection `commands` hold.
    fn draw_projected(
        &mut self,
        gpu: &Gpu,
        commands: Commands<'_>,
        identities: Option<&DeviceIdentities>,
        with_depth: bool,
    ) -> Result<RenderedImage, GpuError> {
        let (width, height) = (self.view().size[0], self.view().rows());
        let pixels = self.view().pixels();
        self.measure(gpu, commands)?;
        let mut commands = Commands::new(gpu, None);
        self.rasterize(gpu, &mut commands, identities, None)?;
        if let Some(identities) = identities {
            self.render_instances(gpu, &mut commands, identities)?;
        }
        let colors = self.colors().read_later(gpu, commands.encoder(), 0, pixels);
        let blended = with_depth.then(|| self.blended().read_later(gpu, commands.encoder(), 0, pixels));
        let instances = identities.map(|_| {
            (
                self.instance_images().read_later(gpu, commands.encoder(), 0, pixels),
                self.foregrounds().read_later(gpu, commands.encoder(), 0, pixels),
            )
        });
        commands.submit();
        let colors = colors.start();
        let blended = blended.map(super::Recorded::start);
        let instances = instances.map(|(images, foregrounds)| (images.start(), foregrounds.start()));

        let colors = colors.wait(gpu)?;
        let grid = |values: Vec<f32>| PixelGrid::from_pixels(width, height, values);
        let depth = match blended {
            Some(blended) => {
                let blended = blended.wait(gpu)?;
                let expected = colors.iter().zip(&blended).map(|(color, blended)| {
                    let coverage = 1.0 - color[3];
                    if coverage > MIN_COVERAGE { blended[0] / coverage } else { 0.0 }
                });
                Some(grid(expected.collect()))
            }
            None => None,
        };
        let instances = match instances {
            Some((images, foregrounds)) => {
                let images = images.wait(gpu)?;
                let part = |channel: usize| grid(images.iter().map(|image| image[channel]).collect());
                Some(InstanceImage {
                    label: part(0).map(|label| *label as u16),
                    probability: part(1),
                    coverage: part(2),
                    entropy: part(3),
                    foreground: grid(foregrounds.wait(gpu)?),
                })
            }
            None => None,
        };
        Ok(RenderedImage {
            alpha: grid(colors.iter().map(|color| 1.0 - color[3]).collect()),
            color: PixelGrid::from_pixels(
                width,
                height,
                colors.into_iter().map(|[red, green, blue, _]| [red, green, blue]).collect(),
            ),
            depth,
            instances,
        })
    }
}
