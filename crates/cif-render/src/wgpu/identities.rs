//! Identities on the device, in the layout that all kernels share.

use cif_field::Identities;

use super::buffers::GpuVec;
use super::device::Gpu;
use super::error::GpuError;

/// Identity rows, compressed sparse rows as in [`Identities`].
#[derive(Debug)]
pub struct DeviceIdentities {
    /// `[N + 1]`.
    pub row_offsets: GpuVec<u32>,
    /// Per entry the dense instance index, ascending in a row, and the bits of its probability.
    pub entries: GpuVec<[u32; 2]>,
    /// Labelled share of each row, `[N]`.
    pub labelled_shares: GpuVec<f32>,
    /// Number of instances K.
    pub instances: usize,
}

impl DeviceIdentities {
    /// A copy of identities with their current probabilities.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic.
    pub fn from_identities(gpu: &Gpu, identities: &Identities, instances: usize) -> Result<Self, GpuError> {
        Ok(Self {
            row_offsets: GpuVec::from_slice(gpu, "rows of identities", &identities.row_offsets)?,
            entries: GpuVec::from_slice(gpu, "entries of identities", &packed_entries(identities))?,
            labelled_shares: GpuVec::from_slice(gpu, "labelled shares", &identities.labelled_shares())?,
            instances,
        })
    }
}

/// Entries in the layout of [`DeviceIdentities::entries`].
#[must_use]
pub fn packed_entries(identities: &Identities) -> Vec<[u32; 2]> {
    let probabilities = identities.probabilities();
    identities.labels.iter().zip(&probabilities).map(|(label, p)| [u32::from(*label), p.to_bits()]).collect()
}
