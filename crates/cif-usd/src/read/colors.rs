//! Colour spaces of attributes, to which `ColorSpaceAPI` of a prim or one above it and the attribute itself may speak.

use cif_scene::assemble::ColorEncoding;
use glam::DMat3;
use pyo3::prelude::*;

use super::reading::Reading;
use super::values::{self, text};

/// Names of what splats without any colour space are: display-referred sRGB. The first is that of USD, the second that
/// of glTF, the last two of older files.
const DISPLAY: [&str; 4] = ["srgb_rec709_scene", "srgb_rec709_display", "sRGB", "srgb_texture"];
/// Names that say nothing about colours.
const NOTHING: [&str; 4] = ["raw", "data", "unknown", "identity"];
/// The space that all others are compared with: linear light of the primaries of BT.709.
const LINEAR: &str = "lin_rec709_scene";

/// Encoding of the colours of an attribute; `None` where they are display values, or where it is not known, which is
/// reported.
pub(super) fn encoding<'py>(
    reading: &Reading<'_, 'py>,
    place: &str,
    attribute: &Bound<'py, PyAny>,
) -> PyResult<Option<ColorEncoding>> {
    let pxr = reading.pxr;
    let api = pxr.usd.getattr("ColorSpaceAPI")?;
    let no_cache = || pxr.py.None();
    let mut name = text(&api.call_method1("ComputeColorSpaceName", (attribute, no_cache()))?)?;
    if name.is_empty() {
        name = authored(attribute)?;
    }
    if name.is_empty() || DISPLAY.contains(&name.as_str()) || NOTHING.contains(&name.as_str()) {
        return Ok(None);
    }
    let spaces = pxr.gf.getattr("ColorSpace")?;
    let is_known = |name: &str| spaces.call_method1("IsValid", (name,)).and_then(|valid| valid.is_truthy());
    // Those of displays have the curves and primaries of those of scenes.
    let named = [name.clone(), name.replace("_display", "_scene"), format!("{name}_scene")];
    let mut space = None;
    for name in &named {
        if space.is_none() && is_known(name)? {
            space = Some(spaces.call1((name,))?);
        }
    }
    let defined = || api.call_method1("ComputeColorSpace", (attribute, no_cache()));
    let space = match space {
        Some(space) => space,
        // The stage may define it.
        None => defined()?,
    };
    let to_xyz = matrix(&space)?;
    let to_rec709 = matrix(&spaces.call1((LINEAR,))?)?.inverse() * to_xyz;
    if !to_rec709.is_finite() || to_xyz == DMat3::IDENTITY {
        reading.warn(format!(
            "{place}: the colour space '{name}' is not known; its colours are taken as display values of sRGB"
        ));
        return Ok(None);
    }
    let number = |method: &str| space.call_method0(method).and_then(|value| value.extract::<f64>());
    let encoding =
        ColorEncoding { to_rec709, gamma: number("GetGamma")?, linear_bias: number("GetLinearBias")? };
    reading.warn(format!(
        "{place}: its colours, of the space {name}, were brought to display values; what of them depends on the view, \
         to first order"
    ));
    Ok(Some(encoding))
}

/// Name of the colour space of an attribute as it is written, also where USD does not know it; empty without one.
fn authored(attribute: &Bound<'_, PyAny>) -> PyResult<String> {
    let own = text(&attribute.call_method0("GetColorSpace")?)?;
    let mut prim = attribute.call_method0("GetPrim")?;
    let mut name = own;
    while name.is_empty() && prim.is_truthy()? {
        if let Some(attribute) = values::attribute(&prim, "colorSpace:name")? {
            let value = attribute.call_method0("Get")?;
            name = if value.is_none() { name } else { text(&value)? };
        }
        prim = prim.call_method0("GetParent")?;
    }
    Ok(name)
}

/// CIE XYZ from linear light of a space, for column vectors.
fn matrix(space: &Bound<'_, PyAny>) -> PyResult<DMat3> {
    let gf = space.call_method0("GetRGBToXYZ")?;
    let mut rows = [[0.0; 3]; 3];
    for (index, row) in rows.iter_mut().enumerate() {
        *row = values::vector(&gf.call_method1("GetRow", (index,))?)?;
    }
    Ok(DMat3::from_cols_array_2d(&rows).transpose())
}
