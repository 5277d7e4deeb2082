//! The schema that is installed is the schema that is written.

use std::path::{Path, PathBuf};

use cif_system::environment::BUILD_PYTHON;

use super::{python, session};
use crate::tokens;

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

#[test]
fn the_generated_schema_is_the_schema_by_hand() {
    let _session = session();
    let properties: Vec<String> = tokens::instance::ALL
        .iter()
        .map(|(name, value_type)| format!("('{name}', '{value_type}')"))
        .collect();
    let program = format!(
        "
import json, os
from pxr import Sdf
folder = os.path.join(path, 'schemas', 'cif')
written = dict([{}])
# Below composition: the schemas of USD that the file sublayers need not be found.
by_hand = Sdf.Layer.FindOrOpen(os.path.join(folder, 'schema.usda'))
generated = Sdf.Layer.FindOrOpen(os.path.join(folder, 'generatedSchema.usda'))
assert list(generated.rootPrims.keys()) == ['{api}'], generated.rootPrims.keys()
ours, theirs = by_hand.GetPrimAtPath('/{api}'), generated.GetPrimAtPath('/{api}')
assert ours.documentation == theirs.documentation
assert list(ours.inheritPathList.GetAddedOrExplicitItems()) == [Sdf.Path('/APISchemaBase')]
for spec in (ours, theirs):
    found = {{name: str(p.typeName) for name, p in spec.attributes.items()}}
    assert found == written, (found, written)
for name in written:
    a, b = ours.attributes[name], theirs.attributes[name]
    assert a.documentation == b.documentation and len(a.documentation) > 20, name
    assert a.default == b.default and a.default is not None, name
    assert a.variability == b.variability == Sdf.VariabilityUniform, name
    assert a.allowedTokens == b.allowedTokens, name
info, = json.load(open(os.path.join(folder, 'plugInfo.json')))['Plugins']
assert info['Type'] == 'resource' and info['LibraryPath'] == ''
(name, schema), = info['Info']['Types'].items()
assert schema['alias'] == {{'UsdSchemaBase': '{api}'}} and schema['schemaKind'] == 'singleApplyAPI'
",
        properties.join(", "),
        api = tokens::INSTANCE_API,
    );
    python(&repository(), &program);
}

#[test]
fn the_wheel_carries_the_same_schema() {
    for file in ["plugInfo.json", "generatedSchema.usda"] {
        let read = |folder: &str| std::fs::read_to_string(repository().join(folder).join(file)).unwrap();
        assert_eq!(read("schemas/cif"), read("crates/cif-python/python/cif/schema"), "{file}: copy it again");
    }
}

#[test]
fn usd_knows_the_schema_where_it_is_installed_and_opens_stages_where_it_is_not() {
    let _session = session();
    let folder = tempfile::tempdir().unwrap();
    let stage = folder.path().join("a.usda");
    crate::export(&super::scenes::Maker::new(3).scene(), &stage, crate::ExportOptions::default()).unwrap();
    let look = "
import sys
from pxr import Usd
stage = Usd.Stage.Open(sys.argv[1])
prim = stage.GetPrimAtPath('/World/red_mug_001')
assert prim.GetAttribute('cif:id').Get() == 1
known = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('CifInstanceAPI')
installed = sys.argv[2] == 'installed'
assert bool(known) == installed and prim.HasAPI('SemanticsLabelsAPI')
assert ('CifInstanceAPI' in prim.GetAppliedSchemas()) == installed
if installed:
    assert prim.GetAttribute('cif:index').GetDocumentation() or known.GetPropertyDocumentation('cif:index')
    assert prim.GetAttribute('cif:id').IsDefined() and not prim.GetAttribute('cif:id').IsCustom()
    other = Usd.Stage.CreateInMemory()
    bare = other.DefinePrim('/A', 'Xform')
    bare.AddAppliedSchema('CifInstanceAPI')
    assert bare.GetAttribute('cif:kind').Get() == 'instance' and bare.GetAttribute('cif:index').Get() == -1
";
    let program = BUILD_PYTHON.text().unwrap_or_else(|| "python3".to_owned());
    for (plugins, case) in [(repository().join("plugin/usd"), "installed"), (PathBuf::new(), "missing")] {
        let output = std::process::Command::new(&program)
            .args(["-c", look])
            .arg(&stage)
            .arg(case)
            .env("PXR_PLUGINPATH_NAME", plugins)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && said.is_empty(), "{case}: {said}");
    }
}
