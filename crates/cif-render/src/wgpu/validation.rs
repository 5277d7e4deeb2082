//! Parses and validates WGSL modules without a GPU, compares what they declare with what Rust believes, and
//! translates them for Metal and Direct3D.

use std::fmt::Write as _;

use naga::back::{hlsl, msl};
use naga::valid::{Capabilities, ModuleInfo, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator};
use naga::{AddressSpace, TypeInner};

use super::device::MOST_UNIFORM_BLOCKS;
use super::form::Form;
use super::kernel::Module;
use super::layout::Layout;
use super::reflection::{Access, Reflection};

/// Storage buffers of an entry point in the core of WebGPU.
const MAX_STORAGE_BUFFERS: usize = 8;
/// Bytes of workgroup memory of an entry point in the core of WebGPU.
const MAX_WORKGROUP_BYTES: u32 = 16_384;
/// Invocations of a workgroup in the core of WebGPU.
const MAX_INVOCATIONS: u32 = 256;

/// Checks that a module is valid WGSL, without any optional feature and in the form with subgroups, that its bindings
/// make a layout, that its entry points are the listed ones, that structures lie as in Rust, that every entry point
/// keeps to the core limits of WebGPU, and that Metal and Direct3D can be given it.
///
/// # Errors
/// With everything that is wrong, a line each.
pub fn validate(module: &Module, layouts: &[Layout]) -> Result<(), String> {
    validate_with(module, "", layouts)
}

/// As [`validate`], with declarations before the file: constants that depend on the scene.
///
/// # Errors
/// As [`validate`].
pub fn validate_with(module: &Module, declarations: &str, layouts: &[Layout]) -> Result<(), String> {
    let wrong: String = Form::ALL
        .into_iter()
        .filter_map(|form| validate_in(form, module, declarations, layouts).err())
        .collect();
    if wrong.is_empty() { Ok(()) } else { Err(wrong) }
}

fn validate_in(form: Form, module: &Module, declarations: &str, layouts: &[Layout]) -> Result<(), String> {
    let source = format!("{declarations}{}", module.source_in(form));
    let parsed = naga::front::wgsl::parse_str(&source)
        .map_err(|error| format!("{}.wgsl: {}", module.name, error.emit_to_string(&source)))?;
    // `unpack2x16float` is core WGSL, though naga has a name for it.
    let core = Capabilities::SHADER_FLOAT16_IN_FLOAT32;
    let (capabilities, stages, operations) = match form {
        Form::Portable => (core, ShaderStages::empty(), SubgroupOperationSet::empty()),
        Form::Subgroups => {
            (core | Capabilities::SUBGROUP, ShaderStages::COMPUTE, SubgroupOperationSet::all())
        }
    };
    let information = Validator::new(ValidationFlags::all(), capabilities)
        .subgroup_stages(stages)
        .subgroup_operations(operations)
        .validate(&parsed)
        .map_err(|error| format!("{}.wgsl: {}", module.name, error.emit_to_string(&source)))?;
    let mut wrong = String::new();
    let mut complain = |what: String| {
        let _ = writeln!(wrong, "{}.wgsl: {what}", module.name);
    };

    let Reflection { bindings, entries } = match Reflection::of_module(&parsed) {
        Ok(reflection) => reflection,
        Err(error) => return Err(format!("{}.wgsl: {error}\n", module.name)),
    };
    let blocks = bindings.iter().filter(|access| **access == Access::Uniform).count();
    if blocks > MOST_UNIFORM_BLOCKS as usize {
        complain(format!("{blocks} uniform blocks, where software has room for {MOST_UNIFORM_BLOCKS}"));
    }

    for (_, ty) in parsed.types.iter() {
        let TypeInner::Struct { members, span } = &ty.inner else { continue };
        let Some(name) = &ty.name else { continue };
        let Some(layout) = layouts.iter().find(|layout| layout.name == name) else { continue };
        if *span as usize != layout.size {
            complain(format!("{name} has {span} bytes, in Rust {}", layout.size));
        }
        for (member, expected) in members.iter().zip(&layout.members) {
            if member.name.as_deref() != Some(expected.name) || member.offset as usize != expected.offset {
                complain(format!("{name}.{:?} lies at {}, in Rust {expected:?}", member.name, member.offset));
            }
        }
        if members.len() != layout.members.len() {
            complain(format!("{name} has {} members, in Rust {}", members.len(), layout.members.len()));
        }
    }

    if entries != module.entries {
        complain(format!("entry points are {entries:?}, Rust knows {:?}", module.entries));
    }
    let mut layouter = naga::proc::Layouter::default();
    if let Err(error) = layouter.update(parsed.to_ctx()) {
        complain(format!("sizes are unknown: {error}"));
    }
    for (index, entry) in parsed.entry_points.iter().enumerate() {
        let invocations: u32 = entry.workgroup_size.iter().product();
        if invocations > MAX_INVOCATIONS {
            complain(format!("{} has {invocations} invocations per workgroup", entry.name));
        }
        let uses = information.get_entry_point(index);
        let (mut storage, mut shared) = (0, 0);
        for (handle, variable) in parsed.global_variables.iter() {
            if uses[handle].is_empty() {
                continue;
            }
            match variable.space {
                AddressSpace::Storage { .. } => storage += 1,
                AddressSpace::WorkGroup => shared += layouter[variable.ty].to_stride(),
                _ => {}
            }
        }
        // The layout of a module binds all its buffers, whichever an entry point uses.
        let bound = bindings.iter().filter(|access| **access != Access::Uniform).count();
        if storage.max(bound) > MAX_STORAGE_BUFFERS {
            complain(format!("{} binds {} storage buffers", entry.name, storage.max(bound)));
        }
        if shared > MAX_WORKGROUP_BYTES {
            complain(format!("{} uses {shared} bytes of workgroup memory", entry.name));
        }
    }
    if let Err(error) = to_msl(form, &parsed, &information) {
        complain(format!("has no translation for Metal: {error}"));
    }
    if let Err(error) = to_hlsl(form, &parsed, &information) {
        complain(format!("has no translation for Direct3D: {error}"));
    }
    if wrong.is_empty() { Ok(()) } else { Err(wrong) }
}

/// Translates a module into the Metal Shading Language, in the oldest version that has what the form uses.
fn to_msl(form: Form, parsed: &naga::Module, information: &ModuleInfo) -> Result<(), String> {
    let lang_version = match form {
        Form::Portable => (2, 0),
        Form::Subgroups => (2, 1),
    };
    let options = msl::Options { lang_version, ..msl::Options::default() };
    let (_, written) = msl::write_string(parsed, information, &options, &msl::PipelineOptions::default())
        .map_err(|error| error.to_string())?;
    written.entry_point_names.into_iter().try_for_each(|entry| entry.map(drop).map_err(|e| e.to_string()))
}

/// Translates a module into the High-Level Shader Language, in the oldest model that has what the form uses.
fn to_hlsl(form: Form, parsed: &naga::Module, information: &ModuleInfo) -> Result<(), String> {
    let shader_model = match form {
        Form::Portable => hlsl::ShaderModel::V5_1,
        Form::Subgroups => hlsl::ShaderModel::V6_0,
    };
    let options = hlsl::Options { shader_model, ..hlsl::Options::default() };
    let mut text = String::new();
    let written = hlsl::Writer::new(&mut text, &options, &hlsl::PipelineOptions::default())
        .write(parsed, information, None)
        .map_err(|error| error.to_string())?;
    written.entry_point_names.into_iter().try_for_each(|entry| entry.map(drop).map_err(|e| e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wgpu::layout::Shared;
    use crate::wgpu::{LAYOUTS, deform, structures, table};

    crate::shared_struct! {
        /// A scalar, a vector that needs alignment, and an array.
        struct Probe {
            a: [f32; 4],
            b: [u32; 2],
            c: f32,
            d: u32,
            e: [[f32; 4]; 3],
        }
    }

    const GOOD: &str = "#import probe\n\
        @group(0) @binding(0) var<uniform> probe: Probe;\n\
        @group(0) @binding(1) var<storage, read_write> out: array<f32>;\n\
        @compute @workgroup_size(64)\n\
        fn run(@builtin(local_invocation_index) i: u32) { out[i] = probe.e[2].x + probe.c; }\n";

    const PROBE: Module = Module {
        name: "probe",
        text: GOOD,
        imports: &[crate::wgpu::Snippet { name: "probe", text: || structures(&[Probe::layout()]) }],
        entries: &["run"],
    };

    #[test]
    fn every_module_is_valid_and_lies_as_in_rust() {
        let layouts: Vec<Layout> = LAYOUTS.iter().map(|layout| layout()).collect();
        // Those of the deformation need the constants of one, and have a test of their own.
        let of_deformation = |module: &Module| deform::MODULES.iter().any(|other| other.name == module.name);
        let modules = || table::modules().filter(|module| !of_deformation(module));
        let wrong: String = modules().filter_map(|module| validate(module, &layouts).err()).collect();
        assert!(wrong.is_empty(), "{wrong}");
        for module in modules() {
            assert!(
                module.text.starts_with("// "),
                "{}.wgsl opens with a paragraph on what it does and names its Rust twin",
                module.name
            );
        }
    }

    #[test]
    fn a_good_module_passes() {
        assert_eq!(validate(&PROBE, &[Probe::layout()]), Ok(()));
    }

    #[test]
    fn every_kind_of_mistake_is_found() {
        let fails = |module: Module, layouts: &[Layout], expected: &str| {
            let text = validate(&module, layouts).expect_err(expected);
            assert!(text.contains(expected), "{expected} not in: {text}");
        };
        let layout = [Probe::layout()];
        fails(Module { text: "fn f( {}", ..PROBE }, &layout, "probe.wgsl");
        let gap = GOOD.replace("@binding(1)", "@binding(2)");
        fails(Module { text: Box::leak(gap.into_boxed_str()), ..PROBE }, &layout, "expected binding 1");
        fails(Module { entries: &["walk"], ..PROBE }, &layout, "entry points");
        let mut moved = Probe::layout();
        moved.members[2].offset += 4;
        fails(PROBE, &[moved], "Probe");
        let mut larger = Probe::layout();
        larger.size += 16;
        fails(PROBE, &[larger], "bytes, in Rust");
        let greedy = "#import probe\n\
            @group(0) @binding(0) var<uniform> probe: Probe;\n\
            @group(0) @binding(1) var<storage, read_write> out: array<f32>;\n\
            var<workgroup> shared_values: array<f32, 5000>;\n\
            @compute @workgroup_size(512)\n\
            fn run(@builtin(local_invocation_index) i: u32) { shared_values[i] = 1.0; out[i] = shared_values[0]; }\n";
        fails(Module { text: greedy, ..PROBE }, &layout, "20000 bytes");
        fails(Module { text: greedy, ..PROBE }, &layout, "512 invocations");
        // What only devices with subgroups do, in a file that is for all.
        let always = GOOD.replace("probe.c;", "subgroupAdd(probe.c);");
        fails(Module { text: Box::leak(always.into_boxed_str()), ..PROBE }, &layout, "probe.wgsl");
        // Validity at all: a uniform that is written.
        let invalid = GOOD.replace("out[i] = ", "probe.c = ");
        fails(Module { text: Box::leak(invalid.into_boxed_str()), ..PROBE }, &layout, "probe.wgsl");
        // What naga accepts but has no translation for.
        let open = GOOD.replace("@compute", "override unset: f32;\n@compute").replace("probe.c;", "unset;");
        let open = Module { text: Box::leak(open.into_boxed_str()), ..PROBE };
        fails(open, &layout, "no translation for Metal");
        fails(open, &layout, "no translation for Direct3D");
    }
}
