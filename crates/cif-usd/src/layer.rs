//! Prims, properties and samples of one layer, written below composition.
//!
//! Writing specs instead of composed prims keeps every opinion where it was put (a variant, a payload), needs no
//! recomposition per prim, and is the same for the root layer and for payloads.

use std::path::Path;

use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};

use crate::pxr::Pxr;
use crate::tokens;

/// A layer being written.
pub(crate) struct Layer<'p, 'py> {
    pub(crate) pxr: &'p Pxr<'py>,
    handle: Bound<'py, PyAny>,
    prim_spec: Bound<'py, PyAny>,
    attribute_spec: Bound<'py, PyAny>,
    /// Time code at which values stand; `None` where they stand at all times, as defaults.
    values_at: Option<f64>,
}

/// Variability of a property: whether it may change over time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Variability {
    /// It may.
    Varying,
    /// It may not.
    Uniform,
}

/// A prim, or the inside of a variant.
pub(crate) struct Prim<'l, 'p, 'py> {
    layer: &'l Layer<'p, 'py>,
    spec: Bound<'py, PyAny>,
    path: String,
}

/// An attribute.
pub(crate) struct Attribute<'l, 'p, 'py> {
    layer: &'l Layer<'p, 'py>,
    spec: Bound<'py, PyAny>,
}

impl<'p, 'py> Layer<'p, 'py> {
    /// A new layer at a path that does not exist yet; the extension decides the format.
    pub(crate) fn create(pxr: &'p Pxr<'py>, path: &Path) -> PyResult<Self> {
        let handle = pxr.sdf.getattr("Layer")?.call_method1("CreateNew", (path.as_os_str(),))?;
        Ok(Self {
            pxr,
            handle,
            prim_spec: pxr.sdf.getattr("CreatePrimInLayer")?,
            attribute_spec: pxr.sdf.getattr("AttributeSpec")?,
            values_at: None,
        })
    }

    /// As [`Layer::create`], for a value clip: values stand at its first time code, and properties that cannot change over
    /// time are left out.
    pub(crate) fn create_clip(pxr: &'p Pxr<'py>, path: &Path, first: f64) -> PyResult<Self> {
        Ok(Self { values_at: Some(first), ..Self::create(pxr, path)? })
    }

    /// The layer itself.
    pub(crate) fn handle(&self) -> &Bound<'py, PyAny> {
        &self.handle
    }

    /// Metadata of the layer.
    pub(crate) fn info(&self, key: &str, value: impl IntoPyObject<'py>) -> PyResult<()> {
        self.handle.getattr("pseudoRoot")?.call_method1("SetInfo", (key, value))?;
        Ok(())
    }

    /// Our entry of `customLayerData`.
    pub(crate) fn mark(&self, ours: Bound<'py, PyDict>) -> PyResult<()> {
        let data = [(tokens::CIF, ours)].into_py_dict(self.pxr.py)?;
        self.handle.setattr("customLayerData", data)
    }

    /// Defines a prim; ancestors that do not exist become overs.
    pub(crate) fn define<'l>(&'l self, path: &str, type_name: &str) -> PyResult<Prim<'l, 'p, 'py>> {
        let prim = self.over(path)?;
        prim.spec.setattr("specifier", self.pxr.sdf.getattr("SpecifierDef")?)?;
        prim.spec.setattr("typeName", type_name)?;
        Ok(prim)
    }

    /// A prim or variant (`/World/mug{physics=none}`) that only adds opinions, made where it does not exist.
    pub(crate) fn over<'l>(&'l self, path: &str) -> PyResult<Prim<'l, 'p, 'py>> {
        let spec = self.prim_spec.call1((&self.handle, path))?;
        Ok(Prim { layer: self, spec, path: path.to_owned() })
    }

    /// Writes the file.
    pub(crate) fn save(&self) -> PyResult<()> {
        if self.handle.call_method0("Save")?.is_truthy()? {
            Ok(())
        } else {
            Err(pyo3::exceptions::PyOSError::new_err("the layer could not be saved"))
        }
    }
}

/// Path of a child of a prim or of a variant.
pub(crate) fn child(parent: &str, name: &str) -> String {
    if parent.ends_with('}') { format!("{parent}{name}") } else { format!("{parent}/{name}") }
}

impl<'l, 'p, 'py> Prim<'l, 'p, 'py> {
    /// Where it is.
    pub(crate) fn path(&self) -> &str {
        &self.path
    }

    /// Metadata.
    pub(crate) fn info(&self, key: &str, value: impl IntoPyObject<'py>) -> PyResult<()> {
        self.spec.call_method1("SetInfo", (key, value))?;
        Ok(())
    }

    /// Applied API schemas, before those of weaker layers.
    pub(crate) fn apply(&self, schemas: &[&str]) -> PyResult<()> {
        let items = [("prependedItems", schemas.to_vec())].into_py_dict(self.layer.pxr.py)?;
        let list = self.layer.pxr.sdf.getattr("TokenListOp")?.call_method("Create", (), Some(&items))?;
        self.info("apiSchemas", list)
    }

    /// Chooses a variant.
    pub(crate) fn select(&self, set: &str, variant: &str) -> PyResult<()> {
        self.spec.getattr("variantSelections")?.set_item(set, variant)
    }

    /// The inside of a variant.
    pub(crate) fn variant(&self, set: &str, variant: &str) -> PyResult<Prim<'l, 'p, 'py>> {
        self.layer.over(&format!("{}{{{set}={variant}}}", self.path))
    }

    /// Another handle to it.
    pub(crate) fn same(&self) -> Self {
        Self { layer: self.layer, spec: self.spec.clone(), path: self.path.clone() }
    }

    /// A child that only adds opinions.
    pub(crate) fn child(&self, name: &str) -> PyResult<Prim<'l, 'p, 'py>> {
        self.layer.over(&child(&self.path, name))
    }

    /// Brings in a prim of another layer, when payloads are loaded.
    pub(crate) fn payload(&self, asset: &str, prim: &str) -> PyResult<()> {
        let payload = self.layer.pxr.sdf.getattr("Payload")?.call1((asset, prim))?;
        self.spec.getattr("payloadList")?.call_method1("Prepend", (payload,))?;
        Ok(())
    }

    /// A new relationship to a prim of the layer.
    pub(crate) fn relate(&self, name: &str, target: &str) -> PyResult<()> {
        let spec = self.layer.pxr.sdf.getattr("RelationshipSpec")?.call1((&self.spec, name, false))?;
        spec.getattr("targetPathList")?.setattr("explicitItems", [target])
    }

    /// A new attribute of a type of `Sdf.ValueTypeNames`, with its default value.
    pub(crate) fn set(
        &self,
        name: &str,
        value_type: &str,
        variability: Variability,
        value: impl IntoPyObject<'py>,
    ) -> PyResult<Attribute<'l, 'p, 'py>> {
        self.create(name, value_type, variability, value, false)
    }

    /// An attribute of no schema.
    pub(crate) fn set_custom(
        &self,
        name: &str,
        value_type: &str,
        value: impl IntoPyObject<'py>,
    ) -> PyResult<Attribute<'l, 'p, 'py>> {
        self.create(name, value_type, Variability::Varying, value, true)
    }

    fn create(
        &self,
        name: &str,
        value_type: &str,
        variability: Variability,
        value: impl IntoPyObject<'py>,
        custom: bool,
    ) -> PyResult<Attribute<'l, 'p, 'py>> {
        let pxr = self.layer.pxr;
        let is_left_out = self.layer.values_at.is_some() && variability == Variability::Uniform;
        let variability = pxr.sdf.getattr(match variability {
            Variability::Varying => "VariabilityVarying",
            Variability::Uniform => "VariabilityUniform",
        })?;
        let value_type = pxr.value_type(value_type)?;
        let spec = self.layer.attribute_spec.call1((&self.spec, name, value_type, variability, custom))?;
        let attribute = Attribute { layer: self.layer, spec };
        match self.layer.values_at {
            _ if is_left_out => {}
            Some(time_code) => attribute.sample(time_code, value)?,
            None => attribute.spec.setattr("default", value)?,
        }
        Ok(attribute)
    }
}

impl<'py> Attribute<'_, '_, 'py> {
    /// Metadata.
    pub(crate) fn info(&self, key: &str, value: impl IntoPyObject<'py>) -> PyResult<()> {
        self.spec.call_method1("SetInfo", (key, value))?;
        Ok(())
    }

    /// Value at a time code.
    pub(crate) fn sample(&self, time_code: f64, value: impl IntoPyObject<'py>) -> PyResult<()> {
        let path = self.spec.getattr("path")?;
        self.layer.handle.call_method1("SetTimeSample", (path, time_code, value))?;
        Ok(())
    }
}
