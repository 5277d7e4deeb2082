//! Thresholds of the blending rule. Source: methods reference 3.1 and 3.3.

/// Smallest blending weight that is drawn: one step of an 8-bit image.
pub const MIN_ALPHA: f32 = 1.0 / 255.0;

/// Largest blending weight, so that `1 / (1 - alpha)` stays at or below 100.
pub const MAX_ALPHA: f32 = 0.99;

/// A pixel is finished when its transmittance would fall below this: `(1 - MAX_ALPHA)^2`, so that one
/// saturated Gaussian never ends a pixel by itself.
pub const MIN_TRANSMITTANCE: f32 = 1e-4;

/// Screen-space dilation of images at the resolution of a capture, px^2.
pub const LOW_PASS: f32 = 0.3;

/// Floor of the antialiasing opacity factor.
pub const MIN_ANTIALIASING: f32 = 0.005;

/// Margin, in half image widths over focal length, to which the Jacobian's ratio x / z is clamped.
pub const JACOBIAN_MARGIN: f32 = 0.3;

pub use cif_field::gaussians::LOG_SCALE_RANGE;

/// Entries of a projected covariance above this are scaled down, so that products stay finite.
pub const MAX_COVARIANCE: f32 = 1e18;

/// Smallest rendered probability of a pixel's label that still carries a gradient.
pub const MIN_LABEL_PROBABILITY: f32 = 1e-8;

/// Pixels with less colour coverage take no part in identity estimation.
pub const MIN_COVERAGE: f32 = 1e-3;

/// Norm to which a Gaussian's camera-space position gradient is clipped.
pub const MAX_POSITION_GRADIENT: f32 = 1e4;

/// Tile edge, pixels.
pub const TILE: u32 = 16;
