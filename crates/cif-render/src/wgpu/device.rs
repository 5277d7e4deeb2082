//! The GPU: which one, what it can do, and what went wrong on it.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use cif_system::environment::GPU_NAME;

use super::error::GpuError;
use super::features::GpuFeatures;
use super::form::{Form, SMALLEST_SUBGROUP, SubgroupUse};

/// Interfaces that are asked for GPUs. OpenGL is left out: its drivers are listed twice where Vulkan is there, and
/// compute is optional in it.
const BACKENDS: wgpu::Backends =
    wgpu::Backends::VULKAN.union(wgpu::Backends::METAL).union(wgpu::Backends::DX12);

/// Uniform blocks of a kernel, at the most.
pub(super) const MOST_UNIFORM_BLOCKS: u32 = 2;

/// Name, features and limits of an adapter, for `cif info --gpu` and logs.
#[derive(Clone, Debug, PartialEq)]
pub struct AdapterFacts {
    /// Name as the driver says it.
    pub name: String,
    /// Vulkan, Metal or Direct3D 12.
    pub interface: String,
    /// Discrete, integrated, virtual, software or other.
    pub kind: &'static str,
    /// Driver and its version.
    pub driver: String,
    /// True when the processor does the work: no GPU at all, then.
    pub software: bool,
    /// True when kernels can be timed on the device.
    pub timestamps: bool,
    /// Least and largest size of its subgroups, where kernels can use them.
    pub subgroups: Option<(u32, u32)>,
    /// True when kernels can compute in 16-bit floats.
    pub half_floats: bool,
    /// True when kernels can read numbers that are kept in 16-bit floats.
    pub packed_half_floats: bool,
    /// Limits that decide how large a scene may be and how kernels are cut.
    pub limits: [(&'static str, u64); 6],
    /// Limits below those that the kernels need; empty when they run.
    pub missing: Vec<String>,
}

impl AdapterFacts {
    fn of(adapter: &wgpu::Adapter) -> Self {
        let info = adapter.get_info();
        let features = adapter.features();
        let limits = adapter.limits();
        Self {
            kind: kind(info.device_type),
            software: info.device_type == wgpu::DeviceType::Cpu,
            interface: interface(info.backend).to_owned(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
            subgroups: features
                .contains(wgpu::Features::SUBGROUP)
                .then_some((info.subgroup_min_size, info.subgroup_max_size)),
            half_floats: features.contains(wgpu::Features::SHADER_F16),
            packed_half_floats: adapter
                .get_downlevel_capabilities()
                .flags
                .contains(wgpu::DownlevelFlags::SHADER_F16_IN_F32),
            limits: named_limits(&limits),
            missing: missing(&limits),
            name: info.name,
        }
    }
}

fn kind(device_type: wgpu::DeviceType) -> &'static str {
    match device_type {
        wgpu::DeviceType::DiscreteGpu => "discrete GPU",
        wgpu::DeviceType::IntegratedGpu => "integrated GPU",
        wgpu::DeviceType::VirtualGpu => "virtual GPU",
        wgpu::DeviceType::Cpu => "software on the processor",
        wgpu::DeviceType::Other => "GPU of unknown kind",
    }
}

fn interface(backend: wgpu::Backend) -> &'static str {
    match backend {
        wgpu::Backend::Vulkan => "Vulkan",
        wgpu::Backend::Metal => "Metal",
        wgpu::Backend::Dx12 => "Direct3D 12",
        _ => "another interface",
    }
}

fn named_limits(limits: &wgpu::Limits) -> [(&'static str, u64); 6] {
    [
        ("storage buffers per kernel", u64::from(limits.max_storage_buffers_per_shader_stage)),
        ("bytes per binding", limits.max_storage_buffer_binding_size),
        ("bytes per buffer", limits.max_buffer_size),
        ("bytes of workgroup memory", u64::from(limits.max_compute_workgroup_storage_size)),
        ("invocations per workgroup", u64::from(limits.max_compute_invocations_per_workgroup)),
        ("workgroups per dimension", u64::from(limits.max_compute_workgroups_per_dimension)),
    ]
}

/// Limits below the core of WebGPU, each with what was found.
fn missing(limits: &wgpu::Limits) -> Vec<String> {
    named_limits(limits)
        .into_iter()
        .zip(named_limits(&wgpu::Limits::defaults()))
        .filter(|((_, found), (_, needed))| found < needed)
        .map(|((name, found), (_, needed))| format!("{found} {name}, {needed} are needed"))
        .collect()
}

/// The first fault that the driver reported, kept until it is asked for.
type Fault = Arc<Mutex<Option<GpuError>>>;

/// A module that the driver has compiled.
#[derive(Clone, Debug)]
pub(super) struct CompiledModule {
    /// Of its bindings.
    pub(super) layout: wgpu::BindGroupLayout,
    /// Number of its bindings.
    pub(super) bindings: usize,
    /// Of its entry points.
    pub(super) pipelines: Vec<wgpu::ComputePipeline>,
}

/// Compiled kernels, by the name and the source of the module.
type Compiled = Arc<Mutex<BTreeMap<(&'static str, String), CompiledModule>>>;

/// A device with its queue and what was compiled for it. Clones share all.
#[derive(Clone, Debug)]
pub struct Gpu {
    device: wgpu::Device,
    queue: wgpu::Queue,
    facts: Arc<AdapterFacts>,
    subgroups: Arc<SubgroupUse>,
    constants_in_storage: bool,
    fault: Fault,
    kernels: Compiled,
}

impl Gpu {
    /// Every adapter that Vulkan, Metal or Direct3D 12 offers, GPUs before software.
    #[must_use]
    pub fn adapters() -> Vec<AdapterFacts> {
        adapters().iter().map(AdapterFacts::of).collect()
    }

    /// As [`Self::open_with`], with subgroups that have not been checked.
    pub(super) fn unchecked(features: GpuFeatures) -> Result<Self, GpuError> {
        let requested = GPU_NAME.text().unwrap_or_default();
        let all = adapters();
        let names: Vec<String> = all.iter().map(|adapter| adapter.get_info().name).collect();
        let matches = |name: &str| name.to_lowercase().contains(&requested.to_lowercase());
        let Some(adapter) = all.into_iter().find(|adapter| matches(&adapter.get_info().name)) else {
            let found = if names.is_empty() {
                "nothing answered".to_owned()
            } else {
                format!("{} does not contain {}={requested}", names.join(", "), GPU_NAME.name())
            };
            return Err(GpuError::NoAdapter { backends: "Vulkan, Metal and Direct3D 12".to_owned(), found });
        };
        Self::of(&adapter, features)
    }

    fn of(adapter: &wgpu::Adapter, features: GpuFeatures) -> Result<Self, GpuError> {
        let facts = AdapterFacts::of(adapter);
        if !facts.missing.is_empty() {
            return Err(GpuError::TooSmall { adapter: facts.name, missing: facts.missing.join("; ") });
        }
        let found = adapter.limits();
        let core = wgpu::Limits::defaults();
        let with_constants = core.max_storage_buffers_per_shader_stage + MOST_UNIFORM_BLOCKS;
        let constants_in_storage = facts.software
            && features.software_storage
            && found.max_storage_buffers_per_shader_stage >= with_constants;
        // Exactly the core limits, so that a kernel that needs more fails everywhere and not on small GPUs only;
        // buffers alone may be as large as the adapter allows.
        let limits = wgpu::Limits {
            max_storage_buffers_per_shader_stage: if constants_in_storage {
                with_constants
            } else {
                core.max_storage_buffers_per_shader_stage
            },
            max_storage_buffer_binding_size: found
                .max_storage_buffer_binding_size
                .min(u64::from(u32::MAX) & !3),
            max_buffer_size: found.max_buffer_size,
            ..core
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("cif"),
            required_features: adapter.features() & features.welcome(facts.software),
            required_limits: limits,
            ..Default::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).map_err(|error| {
            GpuError::NoDevice { adapter: facts.name.clone(), message: error.to_string() }
        })?;
        let fault = Fault::default();
        let keep = |fault: &Fault, error: GpuError| {
            // The first fault is the cause; what follows are its consequences.
            fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
        };
        let kept = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error| {
            keep(
                &kept,
                match error {
                    wgpu::Error::OutOfMemory { source } => GpuError::OutOfMemory(source.to_string()),
                    wgpu::Error::Validation { description, .. }
                    | wgpu::Error::Internal { description, .. } => GpuError::Rejected(description),
                },
            );
        }));
        let kept = Arc::clone(&fault);
        device.set_device_lost_callback(move |_, message| {
            let mut fault = kept.lock().unwrap_or_else(PoisonError::into_inner);
            // Rejections by a lost device are reported before the loss, of which they are a consequence.
            if matches!(*fault, None | Some(GpuError::Rejected(_))) {
                *fault = Some(GpuError::Lost(message));
            }
        });
        let has_subgroups = device.features().contains(wgpu::Features::SUBGROUP);
        let subgroups = match (has_subgroups, facts.subgroups) {
            (true, Some((smallest, _))) if smallest < SMALLEST_SUBGROUP => SubgroupUse::Small(smallest),
            (true, _) => SubgroupUse::Used,
            (false, Some(_)) if facts.software && features.subgroups => SubgroupUse::Software,
            (false, Some(_)) => SubgroupUse::HeldBack,
            (false, None) => SubgroupUse::Missing,
        };
        let (facts, subgroups) = (Arc::new(facts), Arc::new(subgroups));
        let kernels = Compiled::default();
        Ok(Self { device, queue, facts, subgroups, constants_in_storage, fault, kernels })
    }

    /// A module by its source: as it was compiled before, or else what `compile` makes of it.
    pub(super) fn compiled(
        &self,
        module: &'static str,
        source: String,
        compile: impl FnOnce(&str) -> Result<CompiledModule, GpuError>,
    ) -> Result<CompiledModule, GpuError> {
        let known = || self.kernels.lock().unwrap_or_else(PoisonError::into_inner);
        let key = (module, source);
        if let Some(module) = known().get(&key) {
            return Ok(module.clone());
        }
        let module = compile(&key.1)?;
        known().insert(key, module.clone());
        Ok(module)
    }

    /// The same without subgroups, for what came out wrong with them; the faults of that are forgotten.
    pub(super) fn without_subgroups(self, wrong: String) -> Self {
        *self.fault.lock().unwrap_or_else(PoisonError::into_inner) = None;
        Self { subgroups: Arc::new(SubgroupUse::Wrong(wrong)), ..self }
    }

    /// Use of subgroups by kernels, or the reason why they are not used.
    #[must_use]
    pub fn subgroups(&self) -> &SubgroupUse {
        &self.subgroups
    }

    /// True when kernels find their constants in storage and not in uniform blocks. So it is where software stands in
    /// for a GPU: Mesa's (22.3) compiles a kernel anew, at each dispatch, for the values of a uniform block that its
    /// branches depend on, and keeps every one of them until the kernel goes.
    #[must_use]
    pub fn constants_in_storage(&self) -> bool {
        self.constants_in_storage
    }

    /// The form in which kernels are compiled.
    #[must_use]
    pub fn form(&self) -> Form {
        match *self.subgroups {
            SubgroupUse::Used => Form::Subgroups,
            _ => Form::Portable,
        }
    }

    /// The device.
    #[must_use]
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The queue.
    #[must_use]
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Name, features and limits of the adapter.
    #[must_use]
    pub fn facts(&self) -> &AdapterFacts {
        &self.facts
    }

    /// Largest storage binding, bytes.
    #[must_use]
    pub fn largest_binding(&self) -> u64 {
        let limits = self.device.limits();
        limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) & !15
    }

    /// True when kernels may use the timestamps of the device.
    #[must_use]
    pub fn has_timestamps(&self) -> bool {
        self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY)
    }

    /// The first fault since the device was opened, if any: out of memory, lost, rejected command.
    ///
    /// # Errors
    /// That fault.
    pub fn check(&self) -> Result<(), GpuError> {
        let fault = || self.fault.lock().unwrap_or_else(PoisonError::into_inner).clone();
        match fault() {
            None => Ok(()),
            Some(GpuError::Rejected(message)) => {
                // The loss of the device is reported when it is asked; it is then the fault.
                let _ = self.device.poll(wgpu::PollType::Poll);
                Err(fault().unwrap_or(GpuError::Rejected(message)))
            }
            Some(fault) => Err(fault),
        }
    }

    /// Waits until everything submitted is done.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn wait(&self) -> Result<(), GpuError> {
        self.device
            .poll(wgpu::PollType::wait_indefinitely())
            .map_err(|error| GpuError::Lost(error.to_string()))?;
        self.check()
    }

    /// Waits until a submission is done, and those before it; later ones go on.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn wait_for(&self, submission: wgpu::SubmissionIndex) -> Result<(), GpuError> {
        self.device
            .poll(wgpu::PollType::Wait { submission_index: Some(submission), timeout: None })
            .map_err(|error| GpuError::Lost(error.to_string()))?;
        self.check()
    }

    /// Reports a fault that was found elsewhere, as the driver would; the first one stays.
    pub fn tell(&self, fault: GpuError) {
        self.fault.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(fault);
    }

    /// Lets finished read-backs arrive, without waiting.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn poll(&self) -> Result<(), GpuError> {
        self.device.poll(wgpu::PollType::Poll).map_err(|error| GpuError::Lost(error.to_string()))?;
        self.check()
    }
}

/// Adapters, best first; equal ones in the order of the driver.
fn adapters() -> Vec<wgpu::Adapter> {
    let descriptor = wgpu::InstanceDescriptor {
        backends: BACKENDS,
        // No validation layers: naga validates every kernel, and layers would print to the console.
        flags: wgpu::InstanceFlags::empty().with_env(),
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    };
    let instance = wgpu::Instance::new(descriptor);
    let mut adapters = pollster::block_on(instance.enumerate_adapters(BACKENDS));
    adapters.sort_by_key(|adapter| match adapter.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    adapters
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_below_the_core_are_named_with_what_was_found() {
        assert!(missing(&wgpu::Limits::defaults()).is_empty());
        let small = wgpu::Limits { max_storage_buffers_per_shader_stage: 4, ..wgpu::Limits::defaults() };
        assert_eq!(missing(&small), ["4 storage buffers per kernel, 8 are needed"]);
    }
}
