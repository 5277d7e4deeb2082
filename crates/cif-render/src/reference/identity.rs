//! Label mass of every Gaussian, from which identity rows are estimated. Source: methods reference 5.1 to 5.3.

use cif_geometry::{PixelGrid, Real};

use super::constant;
use super::pixel::PixelState;
use super::project::Splat2d;
use super::rasterize::{footprint, weight};
use crate::constants::{MIN_COVERAGE, MIN_TRANSMITTANCE};
use crate::cpu::IdentityCounts;

/// Adds a view's colour-weighted label mass (5.1): `w_i(u) = T_i alpha_i / A_c(u)` goes to d_i on every pixel
/// covered by at least 1e-3, and to n_i^y where the pixel has a label y. `pixels` is the forward pass.
pub fn count_label_mass<R: Real>(
    splats: &[Option<Splat2d<R>>],
    order: &[u32],
    pixels: &PixelGrid<PixelState<R>>,
    labels: &PixelGrid<u16>,
    counts: &mut IdentityCounts,
) {
    for (position, (state, label)) in pixels.pixels.iter().zip(&labels.pixels).enumerate() {
        let coverage = R::one() - state.transmittance;
        if coverage < constant(MIN_COVERAGE) {
            continue;
        }
        let pixel = [position as u32 % pixels.width, position as u32 / pixels.width];
        let mut transmittance = R::one();
        for &index in order {
            let Some(splat) = &splats[index as usize] else { continue };
            let footprint = footprint(splat, pixel);
            let Some(alpha) = weight(splat.opacity, footprint.peak) else { continue };
            let next = transmittance * (R::one() - alpha.value);
            if next < constant(MIN_TRANSMITTANCE) {
                break;
            }
            let mass = (transmittance * alpha.value / coverage).to_double();
            counts.add_total_mass(index as usize, mass);
            if let Some(instance) = label.checked_sub(1) {
                counts.add_label_mass(index as usize, instance, mass);
            }
            transmittance = next;
        }
    }
}
