//! Changes of the set of Gaussians on the device.

use bytemuck::Pod;
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuVec, Kernel, Uniform, workgroups};

use super::kernels::{FRESH, REARRANGE, Rearrangement, entries};

/// Where the rows of a new set come from, on the device.
#[derive(Debug)]
pub struct GpuRearranger {
    rearrange: Kernel,
}

/// Rule for the rows of an array when the set of Gaussians changes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RowRule {
    /// Fresh rows are zeros instead of copies of their parent's.
    pub fresh_are_zero: bool,
    /// A float of every row that becomes zero.
    pub zero_column: Option<u32>,
    /// Bits of the floats that become zero in rows marked by [`super::kernels::RESTARTED`].
    pub restarted_columns: u32,
}

impl GpuRearranger {
    /// # Errors
    /// When the driver rejects the kernel.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [rearrange] = entries(gpu, &REARRANGE)?;
        Ok(Self { rearrange })
    }

    /// Records an array's new rows, in memory of their own. `origins` are old rows, with [`FRESH`] and
    /// [`super::kernels::RESTARTED`] added as marks.
    ///
    /// # Errors
    /// When they exceed what the device binds, with the arithmetic; the array stays as it was.
    pub fn record<T: Pod>(
        &self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        origins: &GpuVec<u32>,
        array: &mut GpuVec<T>,
        rule: RowRule,
    ) -> Result<(), GpuError> {
        let after = array.like(gpu, origins.len())?;
        let width = size_of::<T>() / size_of::<f32>();
        let uniform = Uniform::new(
            gpu,
            "rearrangement",
            &Rearrangement {
                rows: origins.len() as u32,
                width: width as u32,
                fresh_are_zero: u32::from(rule.fresh_are_zero),
                zero_column: rule.zero_column.unwrap_or(u32::MAX),
                restarted_columns: rule.restarted_columns,
                ..Rearrangement::default()
            },
        );
        let bindings = [uniform.binding(), origins.binding(), array.binding(), after.binding()];
        let group = self.rearrange.bind(gpu, &bindings);
        commands.stage("rearrange", |stage| {
            stage.dispatch(&self.rearrange, &group, workgroups(origins.len() * width, 256));
        });
        *array = after;
        Ok(())
    }
}

/// Follows one more change: `origins` are of the rows before it.
#[must_use]
pub fn compose(origins: &[u32], kept: &[Option<u32>], parents: &[u32]) -> Vec<u32> {
    kept.iter()
        .zip(parents)
        .map(|(kept, parent)| match kept {
            Some(row) => origins[*row as usize],
            None => origins[*parent as usize] | FRESH,
        })
        .collect()
}
