//! Holding Gaussians to known motion, on the device.

use cif_render::wgpu::deform::DeformedGaussians;
use cif_render::wgpu::{Commands, Gpu, GpuError, GpuGaussians, GpuVec, Kernel, Uniform, workgroups};

use super::kernels::{DISPLACEMENT, Motion, entries};
use crate::guidance::Pulls;
use crate::losses::displacement::Pull;

/// Floats of a guide on the device: three vectors of 16 bytes, and a matrix of three such columns.
const GUIDE_FLOATS: usize = 24;

/// Pulls on the device.
#[derive(Debug)]
pub struct GpuMotion {
    motion: Uniform<Motion>,
    guide_of: GpuVec<u32>,
    shifts: GpuVec<[f32; 4]>,
    guides: GpuVec<[f32; GUIDE_FLOATS]>,
    follow: Kernel,
    displace: Kernel,
}

impl GpuMotion {
    /// # Errors
    /// When the driver rejects a kernel.
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let [follow, displace] = entries(gpu, &DISPLACEMENT)?;
        Ok(Self {
            motion: Uniform::new(gpu, "motion", &Motion::default()),
            guide_of: GpuVec::zeros(gpu, "guides of the Gaussians", 0)?,
            shifts: GpuVec::zeros(gpu, "places on the paths", 0)?,
            guides: GpuVec::zeros(gpu, "guides", 0)?,
            follow,
            displace,
        })
    }

    /// Sends the guide of every Gaussian (0 for what is held in place, `FREE` for what nothing holds); none switches everything off.
    ///
    /// # Errors
    /// When they exceed what the device binds.
    pub fn send(&mut self, gpu: &Gpu, guide_of: &[u16]) -> Result<(), GpuError> {
        let wide: Vec<u32> = guide_of.iter().map(|guide| u32::from(*guide)).collect();
        self.guide_of.replace(gpu, &wide)?;
        Ok(())
    }

    /// Records the gradients by what the deformation adds to the centres, `posed` at the time of the view: `v_posed` gets
    /// them, and `v_canonical` loses what the direct path will add. `extent` is that of the scene, metres. One time per
    /// submission: it is written at once.
    ///
    /// # Errors
    /// When the objects exceed what the device binds.
    pub(crate) fn record(
        &mut self,
        gpu: &Gpu,
        commands: &mut Commands<'_>,
        pulls: &Pulls,
        extent: f64,
        posed: &GpuGaussians,
        gaussians: DeformedGaussians<'_>,
    ) -> Result<(), GpuError> {
        let Pulls { shifts, strengths: [path, place] } = pulls;
        let DeformedGaussians { canonical, v_posed, v_canonical } = gaussians;
        let n = canonical.len();
        if self.guide_of.len() != n || n == 0 {
            return Ok(());
        }
        let places: Vec<[f32; 4]> =
            shifts.iter().map(|shift| shift.as_vec3().extend(0.0).to_array()).collect();
        self.shifts.replace(gpu, &places)?;
        self.guides.resize(gpu, shifts.len().max(1))?;
        let pull = |pull: Pull| [pull.weight as f32, pull.reach as f32];
        self.motion.write(
            gpu,
            &Motion {
                path: pull(*path),
                place: pull(*place),
                scale: (1.0 / (n as f64 * extent)) as f32,
                gaussians: n as u32,
                unused: [0.0; 2],
            },
        );
        let bindings = [
            self.motion.binding(),
            posed.geometry.binding(),
            canonical.geometry.binding(),
            self.guide_of.binding(),
            self.shifts.binding(),
            self.guides.binding(),
            v_posed.geometry.binding(),
            v_canonical.geometry.binding(),
        ];
        let follow = self.follow.bind(gpu, &bindings);
        let displace = self.displace.bind(gpu, &bindings);
        commands.stage("guidance", |stage| {
            stage.dispatch(&self.follow, &follow, [shifts.len() as u32, 1, 1]);
            stage.dispatch(&self.displace, &displace, workgroups(n, 128));
        });
        Ok(())
    }
}
