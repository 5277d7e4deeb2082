//! Compute kernels from embedded WGSL files.
//!
//! A [`Module`] is one WGSL file with the snippets that it imports and its entry points; bindings are those that the
//! file declares, see [`super::reflection`]. Line by line, `#import name` is replaced by the snippet of that name, once;
//! snippets may import others. `#paste name` is replaced each time. Constants and structures that Rust knows are snippets made by [`constants`] and
//! [`structures`], so that nothing is typed twice; what exists in two forms is chosen for the device, see
//! [`super::workgroup`].
//!
//! A [`Kernel`] is one entry point of a module on a device. [`Commands`] records dispatches, grouped into stages
//! that are timed on the device where it has timestamps.

use super::buffers::GpuVec;
use super::device::{CompiledModule, Gpu};
use super::error::GpuError;
use super::form::Form;
use super::layout::Layout;
use super::reflection::{Access, Reflection};
pub use super::snippet::Snippet;

/// A WGSL file.
#[derive(Clone, Copy, Debug)]
pub struct Module {
    /// Name of the stage and of the file.
    pub name: &'static str,
    /// The file.
    pub text: &'static str,
    /// Snippets that the file may import.
    pub imports: &'static [Snippet],
    /// Entry points.
    pub entries: &'static [&'static str],
}

impl Module {
    /// The text with its imports, in the portable form.
    ///
    /// # Panics
    /// When the file imports what the module does not list.
    #[must_use]
    pub fn source(&self) -> String {
        self.source_in(Form::Portable)
    }

    /// The text with its imports, in a form.
    ///
    /// # Panics
    /// As [`Self::source`].
    #[must_use]
    pub fn source_in(&self, form: Form) -> String {
        let mut done = Vec::new();
        let mut out = String::new();
        self.expand(self.text, form, &mut done, &mut out);
        out
    }

    fn expand(&self, text: &str, form: Form, done: &mut Vec<&'static str>, out: &mut String) {
        for line in text.lines() {
            let directive = line.trim();
            let imported = directive.strip_prefix("#import ");
            let Some(name) = imported.or_else(|| directive.strip_prefix("#paste ")) else {
                out.push_str(line);
                out.push('\n');
                continue;
            };
            let snippet =
                form.snippets().iter().chain(self.imports).find(|snippet| snippet.name == name.trim());
            let snippet =
                snippet.unwrap_or_else(|| panic!("{}.wgsl imports `{name}`, which is not there", self.name));
            if imported.is_none() || !done.contains(&snippet.name) {
                done.push(snippet.name);
                self.expand(&(snippet.text)(), form, done, out);
            }
        }
    }
}

/// WGSL declarations of structures.
#[must_use]
pub fn structures(layouts: &[Layout]) -> String {
    layouts.iter().map(Layout::wgsl).collect()
}

/// A constant for WGSL, with every bit of it.
#[derive(Clone, Copy, Debug)]
pub enum Constant {
    /// `f32`.
    Float(f32),
    /// `u32`.
    Unsigned(u32),
}

/// WGSL declarations of constants.
#[must_use]
pub fn constants(named: &[(&str, Constant)]) -> String {
    named
        .iter()
        .map(|(name, value)| match value {
            // The shortest decimal that reads back as the same bits.
            Constant::Float(value) => format!("const {name}: f32 = {value:e}f;\n"),
            Constant::Unsigned(value) => format!("const {name}: u32 = {value}u;\n"),
        })
        .collect()
}

/// An entry point on a device.
#[derive(Clone, Debug)]
pub struct Kernel {
    label: String,
    pipeline: wgpu::ComputePipeline,
    layout: wgpu::BindGroupLayout,
    bindings: usize,
}

impl Kernel {
    /// Every entry point of a module, in order; compiled unless the device has them already.
    ///
    /// # Errors
    /// When the driver rejects it.
    pub fn compile(gpu: &Gpu, module: &Module) -> Result<Vec<Self>, GpuError> {
        Self::compile_with(gpu, module, "")
    }

    /// As [`Self::compile`], with declarations before the file: constants that depend on the scene.
    ///
    /// # Errors
    /// When the driver rejects it.
    pub fn compile_with(gpu: &Gpu, module: &Module, declarations: &str) -> Result<Vec<Self>, GpuError> {
        let mut source = format!("{declarations}{}", module.source_in(gpu.form()));
        if gpu.constants_in_storage() {
            source = source.replace("var<uniform>", "var<storage, read>");
        }
        let compiled =
            gpu.compiled(module.name, source, |source| Self::compile_source(gpu, module, source))?;
        let CompiledModule { layout, bindings, pipelines } = compiled;
        let kernel = |(entry, pipeline)| Self {
            label: format!("{}.{entry}", module.name),
            pipeline,
            layout: layout.clone(),
            bindings,
        };
        Ok(module.entries.iter().zip(pipelines).map(kernel).collect())
    }

    fn compile_source(gpu: &Gpu, module: &Module, source: &str) -> Result<CompiledModule, GpuError> {
        let rejected = |error: String| GpuError::Rejected(format!("{}.wgsl: {error}", module.name));
        let reflection = Reflection::of_source(source).map_err(rejected)?;
        let device = gpu.device();
        let scope = device.push_error_scope(wgpu::ErrorFilter::Validation);
        let shader = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(module.name),
            source: wgpu::ShaderSource::Wgsl(source.into()),
        });
        let entries: Vec<wgpu::BindGroupLayoutEntry> = (0_u32..)
            .zip(&reflection.bindings)
            .map(|(binding, access)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match access {
                        Access::Uniform => wgpu::BufferBindingType::Uniform,
                        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        Access::ReadWrite => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some(module.name),
            entries: &entries,
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(module.name),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipelines = module
            .entries
            .iter()
            .map(|entry| {
                device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(entry),
                    layout: Some(&pipeline_layout),
                    module: &shader,
                    entry_point: Some(entry),
                    compilation_options: wgpu::PipelineCompilationOptions {
                        // Kernels set what they read.
                        zero_initialize_workgroup_memory: false,
                        ..Default::default()
                    },
                    cache: None,
                })
            })
            .collect();
        match pollster::block_on(scope.pop()) {
            Some(error) => Err(rejected(error.to_string())),
            None => gpu.check().map(|()| CompiledModule {
                layout,
                bindings: reflection.bindings.len(),
                pipelines,
            }),
        }
    }

    /// A bind group of the module's bindings, in order.
    ///
    /// # Panics
    /// When the number differs from the module's.
    #[must_use]
    pub fn bind(&self, gpu: &Gpu, resources: &[wgpu::BindingResource<'_>]) -> wgpu::BindGroup {
        assert_eq!(resources.len(), self.bindings, "bindings of {}", self.label);
        let entries: Vec<wgpu::BindGroupEntry<'_>> = resources
            .iter()
            .enumerate()
            .map(|(binding, resource)| wgpu::BindGroupEntry {
                binding: binding as u32,
                resource: resource.clone(),
            })
            .collect();
        gpu.device().create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(&self.label),
            layout: &self.layout,
            entries: &entries,
        })
    }
}

/// Workgroups that cover `count` items, at most 65 535 in x; kernels compute their item from both indices:
/// `(y * 65535 + x) * workgroup size + local index`.
#[must_use]
pub fn workgroups(count: usize, workgroup_size: usize) -> [u32; 3] {
    let groups = count.div_ceil(workgroup_size);
    let x = groups.min(MAX_WORKGROUPS as usize);
    [x as u32, if x == 0 { 0 } else { groups.div_ceil(x) as u32 }, 1]
}

/// Workgroups per dimension that every device has.
pub const MAX_WORKGROUPS: u32 = 65_535;

/// Recorded work.
#[derive(Debug)]
pub struct Commands<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    timestamps: Option<&'a mut Timestamps>,
}

impl<'a> Commands<'a> {
    /// Nothing yet; with `timestamps`, stages are timed on the device.
    #[must_use]
    pub fn new(gpu: &'a Gpu, timestamps: Option<&'a mut Timestamps>) -> Self {
        let encoder = gpu.device().create_command_encoder(&Default::default());
        let mut timestamps = timestamps;
        if let Some(timestamps) = &mut timestamps {
            timestamps.names.clear();
        }
        Self { gpu, encoder, timestamps }
    }

    /// The encoder, for copies and read-backs between stages.
    pub fn encoder(&mut self) -> &mut wgpu::CommandEncoder {
        &mut self.encoder
    }

    /// Sets an array to zero bytes.
    pub fn clear<T: bytemuck::Pod>(&mut self, array: &GpuVec<T>) {
        let bytes = ((array.len() * size_of::<T>()) as u64).next_multiple_of(4);
        if bytes > 0 {
            self.encoder.clear_buffer(array.buffer(), 0, Some(bytes));
        }
    }

    /// Copies as many elements as the source has.
    ///
    /// # Panics
    /// When the target has fewer.
    pub fn copy<T: bytemuck::Pod>(&mut self, source: &GpuVec<T>, target: &GpuVec<T>) {
        assert!(source.len() <= target.len(), "{} elements do not fit {}", source.len(), target.len());
        let bytes = ((source.len() * size_of::<T>()) as u64).next_multiple_of(4);
        if bytes > 0 {
            self.encoder.copy_buffer_to_buffer(source.buffer(), 0, target.buffer(), 0, bytes);
        }
    }

    /// Sets some elements to zero bytes.
    pub fn clear_range<T: bytemuck::Pod>(&mut self, array: &GpuVec<T>, first: usize, count: usize) {
        let size = size_of::<T>() as u64;
        self.encoder.clear_buffer(array.buffer(), first as u64 * size, Some(count as u64 * size));
    }

    /// Records the dispatches of a stage.
    pub fn stage(&mut self, name: &'static str, record: impl FnOnce(&mut Stage<'_>)) {
        let timestamp_writes = self.timestamps.as_mut().and_then(|timestamps| timestamps.next(name));
        let pass = self
            .encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(name), timestamp_writes });
        record(&mut Stage { pass });
    }

    /// Submits.
    pub fn submit(mut self) -> wgpu::SubmissionIndex {
        if let Some(timestamps) = &mut self.timestamps {
            timestamps.resolve(&mut self.encoder);
        }
        self.gpu.queue().submit([self.encoder.finish()])
    }
}

/// Dispatches of one stage; each sees what those before it wrote.
#[derive(Debug)]
pub struct Stage<'p> {
    pass: wgpu::ComputePass<'p>,
}

impl Stage<'_> {
    /// Runs a kernel; none of the counts may be 0 for anything to happen.
    pub fn dispatch(&mut self, kernel: &Kernel, bind_group: &wgpu::BindGroup, [x, y, z]: [u32; 3]) {
        if x > 0 && y > 0 && z > 0 {
            self.pass.set_pipeline(&kernel.pipeline);
            self.pass.set_bind_group(0, bind_group, &[]);
            self.pass.dispatch_workgroups(x, y, z);
        }
    }

    /// Runs a kernel with the three counts at an element (of 4 bytes) of an array.
    pub fn dispatch_indirect(
        &mut self,
        kernel: &Kernel,
        bind_group: &wgpu::BindGroup,
        counts: &GpuVec<u32>,
        element: usize,
    ) {
        self.pass.set_pipeline(&kernel.pipeline);
        self.pass.set_bind_group(0, bind_group, &[]);
        self.pass.dispatch_workgroups_indirect(counts.buffer(), 4 * element as u64);
    }
}

/// Times of stages, on devices that have timestamps.
#[derive(Debug)]
pub struct Timestamps {
    queries: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    nanoseconds: f64,
    names: Vec<&'static str>,
}

impl Timestamps {
    /// Stages timed in one submission; further ones are not.
    const STAGES: u32 = 64;

    /// `None` where the device has no timestamps.
    #[must_use]
    pub fn new(gpu: &Gpu) -> Option<Self> {
        gpu.has_timestamps().then(|| Self {
            queries: gpu.device().create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("timestamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * Self::STAGES,
            }),
            resolved: gpu.device().create_buffer(&wgpu::BufferDescriptor {
                label: Some("timestamps"),
                size: u64::from(2 * Self::STAGES) * 8,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            nanoseconds: f64::from(gpu.queue().get_timestamp_period()),
            names: Vec::new(),
        })
    }

    fn next(&mut self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let index = self.names.len() as u32;
        if index == Self::STAGES {
            return None;
        }
        self.names.push(name);
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(2 * index),
            end_of_pass_write_index: Some(2 * index + 1),
        })
    }

    fn resolve(&self, encoder: &mut wgpu::CommandEncoder) {
        if !self.names.is_empty() {
            encoder.resolve_query_set(&self.queries, 0..2 * self.names.len() as u32, &self.resolved, 0);
        }
    }

    /// Stages of the last submission and their times, waiting for it.
    ///
    /// # Errors
    /// When the device is lost or a command was rejected.
    pub fn read(&self, gpu: &Gpu) -> Result<Vec<(&'static str, std::time::Duration)>, GpuError> {
        if self.names.is_empty() {
            return Ok(Vec::new());
        }
        let bytes = self.names.len() as u64 * 16;
        let staging = gpu.device().create_buffer(&wgpu::BufferDescriptor {
            label: Some("timestamps"),
            size: bytes,
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let mut encoder = gpu.device().create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &staging, 0, bytes);
        gpu.queue().submit([encoder.finish()]);
        staging.map_async(wgpu::MapMode::Read, .., |_| {});
        gpu.wait()?;
        let view = staging.get_mapped_range(..).map_err(|error| GpuError::Lost(error.to_string()))?;
        let ticks: Vec<u64> = bytemuck::pod_collect_to_vec(&view);
        Ok(self
            .names
            .iter()
            .zip(ticks.chunks_exact(2))
            .map(|(name, pair)| {
                let elapsed = pair[1].saturating_sub(pair[0]) as f64 * self.nanoseconds;
                (*name, std::time::Duration::from_nanos(elapsed as u64))
            })
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn imports_are_expanded_once_and_in_place() {
        const A: Snippet = Snippet { name: "a", text: || "#import b\nconst A = B;".to_owned() };
        const B: Snippet = Snippet { name: "b", text: || "const B = 1;".to_owned() };
        let module = Module {
            name: "test",
            text: "#import b\n#import a\n#import a\nfn f() {}\n#paste b\n#paste b",
            imports: &[A, B],
            entries: &[],
        };
        let expected = "const B = 1;\nconst A = B;\nfn f() {}\nconst B = 1;\nconst B = 1;\n";
        assert_eq!(module.source(), expected, "imported once, pasted each time");
    }

    #[test]
    fn constants_keep_every_bit() {
        let third = 1.0_f32 / 255.0;
        let text = constants(&[("A", Constant::Float(third)), ("B", Constant::Unsigned(7))]);
        assert_eq!(text.lines().last(), Some("const B: u32 = 7u;"));
        let digits =
            text.lines().next().and_then(|line| line.split("= ").nth(1)).unwrap().trim_end_matches("f;");
        assert_eq!(digits.parse::<f32>().unwrap().to_bits(), third.to_bits());
    }

    #[test]
    fn workgroups_fold_into_two_dimensions() {
        assert_eq!(workgroups(0, 256), [0, 0, 1]);
        assert_eq!(workgroups(1, 256), [1, 1, 1]);
        assert_eq!(workgroups(257, 256), [2, 1, 1]);
        let [x, y, _] = workgroups(100_000_000, 256);
        assert!(x <= MAX_WORKGROUPS && x as usize * y as usize * 256 >= 100_000_000);
    }

    #[test]
    fn kernels_run_indirectly_too_and_results_arrive_without_waiting() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        const DOUBLE: Module = Module {
            name: "double",
            text: "@group(0) @binding(0) var<uniform> factor: vec4u;\n\
                @group(0) @binding(1) var<storage, read_write> values: array<u32>;\n\
                @compute @workgroup_size(64)\n\
                fn run(@builtin(global_invocation_id) id: vec3u) {\n\
                if (id.x < arrayLength(&values)) { values[id.x] *= factor.x; } }",
            imports: &[],
            entries: &["run"],
        };
        let kernel = Kernel::compile(&gpu, &DOUBLE).unwrap().remove(0);
        let factor = crate::wgpu::Uniform::new(&gpu, "factor", &[2_u32, 0, 0, 0]);
        let input: Vec<u32> = (0..1000).collect();
        let mut values = GpuVec::from_slice(&gpu, "values", &input).unwrap();
        let counts = GpuVec::from_slice(&gpu, "counts", &[9_u32, 16, 1, 1]).unwrap();
        let group = kernel.bind(&gpu, &[factor.binding(), values.binding()]);
        let mut times = Timestamps::new(&gpu);
        let mut commands = Commands::new(&gpu, times.as_mut());
        commands.stage("direct", |stage| stage.dispatch(&kernel, &group, workgroups(1000, 64)));
        commands.stage("indirect", |stage| stage.dispatch_indirect(&kernel, &group, &counts, 1));
        let recorded = values.read_later(&gpu, commands.encoder(), 0, 1000);
        commands.submit();
        let mut arriving = recorded.start();
        let mut looks = 0_u64;
        let result = loop {
            match arriving.take(&gpu).unwrap() {
                Ok(values) => break values,
                Err(again) => arriving = again,
            }
            looks += 1;
            assert!(looks < 1 << 40, "never arrives");
        };
        assert_eq!(result, input.iter().map(|v| v * 4).collect::<Vec<_>>());
        if let Some(times) = times {
            let rows = times.read(&gpu).unwrap();
            assert_eq!(rows.iter().map(|row| row.0).collect::<Vec<_>>(), ["direct", "indirect"]);
        }
        // Growing keeps the values that it is asked to keep.
        let before = values.generation();
        assert!(values.resize_keeping(&gpu, 5000).unwrap() && values.generation() > before);
        assert_eq!(values.read_range(&gpu, 998, 4).unwrap(), [998 * 4, 999 * 4, 0, 0]);
        assert!(!values.resize(&gpu, 10).unwrap(), "shrinking allocates nothing");
        assert!(values.resize(&gpu, 1 << 40).is_err());
        assert_eq!(values.len(), 10);
    }

    #[test]
    fn a_device_compiles_a_source_once() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        let text = "@group(0) @binding(0) var<storage, read_write> values: array<u32>;\n\
            @compute @workgroup_size(64)\n\
            fn run(@builtin(global_invocation_id) id: vec3u) { values[id.x] = STEP; }";
        let module = Module { name: "step", text, imports: &[], entries: &["run"] };
        let compiled = |gpu: &Gpu, step: u32| {
            let declarations = constants(&[("STEP", Constant::Unsigned(step))]);
            Kernel::compile_with(gpu, &module, &declarations).unwrap().remove(0).pipeline
        };
        let first = compiled(&gpu, 1);
        assert!(compiled(&gpu.clone(), 1) == first, "clones share what was compiled");
        assert!(compiled(&gpu, 2) != first, "other constants make another kernel");
    }

    #[test]
    fn a_kernel_that_the_driver_rejects_is_an_error_that_names_the_file() {
        let Some(gpu) = crate::wgpu::testing::gpu() else { return };
        let module = Module { name: "broken", text: "fn f( {", imports: &[], entries: &["run"] };
        let error = Kernel::compile(&gpu, &module).unwrap_err();
        assert!(error.to_string().contains("broken.wgsl"), "{error}");
        gpu.check().expect("the fault was handled where it arose");
    }
}
