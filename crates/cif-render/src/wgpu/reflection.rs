//! Bindings and entry points of WGSL, as naga finds them: bind group layouts are made of these, so that no list of them
//! is kept next to the file.

use naga::{AddressSpace, StorageAccess};

/// Address space and access mode of a binding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// `var<uniform>`.
    Uniform,
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    ReadWrite,
}

/// Declarations of a module that a pipeline layout depends on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reflection {
    /// Bindings of group 0, in the order of their numbers, which are 0, 1, 2 and so on.
    pub bindings: Vec<Access>,
    /// Names of the entry points, in the order of the file.
    pub entries: Vec<String>,
}

impl Reflection {
    /// Parses a source and collects its declarations.
    ///
    /// # Errors
    /// When the source is not WGSL, with the place, and as [`Self::of_module`].
    pub fn of_source(source: &str) -> Result<Self, String> {
        let module = naga::front::wgsl::parse_str(source).map_err(|error| error.emit_to_string(source))?;
        Self::of_module(&module)
    }

    /// Collects the declarations of a parsed module.
    ///
    /// # Errors
    /// When a buffer is bound in another group than 0, when a number is left out or used twice, or when something other
    /// than a buffer is bound.
    pub fn of_module(module: &naga::Module) -> Result<Self, String> {
        let mut numbered = Vec::new();
        for (_, variable) in module.global_variables.iter() {
            let Some(binding) = &variable.binding else { continue };
            let name = variable.name.as_deref().unwrap_or("a variable without a name");
            if binding.group != 0 {
                return Err(format!("`{name}` is bound in group {}, expected group 0", binding.group));
            }
            let access = match variable.space {
                AddressSpace::Uniform => Access::Uniform,
                AddressSpace::Storage { access } if access.contains(StorageAccess::STORE) => {
                    Access::ReadWrite
                }
                AddressSpace::Storage { .. } => Access::Read,
                other => return Err(format!("`{name}` is bound in {other:?}, expected uniform or storage")),
            };
            numbered.push((binding.binding, access, name));
        }
        numbered.sort_by_key(|(number, ..)| *number);
        for (expected, (number, _, name)) in (0_u32..).zip(&numbered) {
            if *number != expected {
                return Err(format!("`{name}` has binding {number}, expected binding {expected}"));
            }
        }
        Ok(Self {
            bindings: numbered.into_iter().map(|(_, access, _)| access).collect(),
            entries: module.entry_points.iter().map(|entry| entry.name.clone()).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ENTRIES: &str =
        "@compute @workgroup_size(64) fn first() {}\n@compute @workgroup_size(1) fn second() {}\n";

    fn of(declarations: &str) -> Result<Reflection, String> {
        Reflection::of_source(&format!("{declarations}{ENTRIES}"))
    }

    #[test]
    fn bindings_come_in_the_order_of_their_numbers() {
        let found = of("@group(0) @binding(2) var<storage, read_write> c: array<u32>;\n\
            @group(0) @binding(0) var<uniform> a: vec4f;\n\
            var<workgroup> shared_values: array<f32, 4>;\n\
            @group(0) @binding(1) var<storage, read> b: array<u32>;\n")
        .unwrap();
        assert_eq!(found.bindings, [Access::Uniform, Access::Read, Access::ReadWrite]);
        assert_eq!(found.entries, ["first", "second"]);
    }

    #[test]
    fn gaps_duplicates_and_other_groups_are_refused_by_name() {
        let fails = |declarations: &str, expected: &str| {
            let message = of(declarations).unwrap_err();
            assert!(message.contains(expected), "{expected} not in: {message}");
        };
        fails(
            "@group(0) @binding(1) var<uniform> late: vec4f;\n",
            "`late` has binding 1, expected binding 0",
        );
        let twice = "@group(0) @binding(0) var<uniform> a: vec4f;\n\
            @group(0) @binding(0) var<storage, read> b: array<u32>;\n";
        fails(twice, "`b` has binding 0, expected binding 1");
        fails("@group(1) @binding(0) var<uniform> a: vec4f;\n", "`a` is bound in group 1");
        fails("@group(0) @binding(0) var a: sampler;\n", "expected uniform or storage");
        fails("fn f( {", "error");
    }
}
