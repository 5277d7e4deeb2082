//! Views of fields.

use cif_field::Field;
use cif_geometry::PinholeCamera;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings, RenderedImage};
use cif_system::memory::Need;
use pyo3::prelude::*;

use crate::camera::Camera;
use crate::error::cif_error;
use crate::process;

/// Renders a view with the requested layers, those of instances where the field has identities.
pub(crate) fn render(
    py: Python<'_>,
    field: &Field,
    camera: &Camera,
    time: f64,
    channels: Channels,
) -> PyResult<RenderedImage> {
    let settings = RenderSettings::of_field(field);
    let instances = channels.instances && field.identities.is_some();
    let channels = Channels { instances, ..channels };
    memory_of_view(camera, channels).check().map_err(cif_error)?;
    process::detach(py, || {
        Renderer::new(SimdLevel::Auto).render(field, &camera.inner, time, &settings, channels)
    })
}

/// Memory of the arrays of a view.
fn memory_of_view(camera: &Camera, channels: Channels) -> Need {
    // Colour and alpha; depth; label, probability, coverage, foreground and entropy.
    let values = 4 + u64::from(channels.depth) + 5 * u64::from(channels.instances);
    let PinholeCamera { width, height, .. } = camera.inner;
    Need {
        bytes: 4 * values * u64::from(width) * u64::from(height),
        arithmetic: format!("{width} x {height} pixels x {values} values x 4 bytes"),
    }
}
