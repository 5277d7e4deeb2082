//! A stage as a scene graph.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use cif_field::SortMetric;
use cif_scene::assemble::{AssembleError, FRAMES_PER_SECOND, Prim, Prims, Timeline, assemble};
use cif_scene::{CaptureFrame, Origin, SceneGraph, SceneOptions, TimeCodes, UpAxis};
use pyo3::prelude::*;

use super::arrays::Arrays;
use super::frames::Frames;
use super::labels::{self, Recorded};
use super::nodes;
use super::open::Instances;
use super::owner::Owner;
use super::reading::Reading;
use super::splats::SplatPrim;
use super::values::{self, plain, text};
use super::{cameras, open, windows};
use crate::pxr::{self, Pxr, reason};
use crate::{ReadOptions, UsdError, tokens};

/// Our entry in the `customLayerData` of a layer.
#[derive(Clone, Default)]
struct Mark {
    ours: bool,
    /// Time codes per second of the layer that it stands on.
    rate: Option<f64>,
    generator: String,
    layout: i64,
    times: Vec<f64>,
    codes: Vec<f64>,
    background: [f32; 3],
    omitted: Vec<String>,
    warnings: Vec<String>,
    windows: i64,
    sort: Option<String>,
    antialiased: Option<bool>,
    frame: CaptureFrame,
    origin: Origin,
}

pub(crate) fn scene(path: &Path, options: ReadOptions) -> Result<SceneGraph, UsdError> {
    pxr::with(|pxr| {
        let (stage, bytes) = open::open_with_layers(pxr, path, options, Instances::Each)?;
        let failed =
            |error: PyErr| UsdError::Unusable { path: path.to_owned(), reason: reason(pxr.py, &error) };
        let mut mark = mark(&stage).map_err(failed)?;
        let expected = i64::from(tokens::LAYOUT_VERSION);
        if mark.ours && mark.layout != expected {
            let (path, generator, found) = (path.to_owned(), mark.generator, mark.layout);
            return Err(UsdError::Layout { path, generator, found, expected });
        }
        if !mark.frame.is_valid() {
            let problem = format!("its layer places the scene nowhere ({:?})", mark.frame);
            let (path, prim) = (path.to_owned(), tokens::WORLD.to_owned());
            let fix =
                "put captureOffset and captureScale of its customLayerData right, or export the scene again";
            return Err(UsdError::Prim { path, prim, problem, fix });
        }
        // A layer of edits that names no rate means ours; USD would take 24 for it and stretch what is below.
        let root = stage.call_method0("GetRootLayer").map_err(failed)?;
        let stage = match (rate(&root).map_err(failed)?, mark.rate) {
            (None, Some(ours)) => open::open_at_rate(pxr, path, ours)?,
            (Some(own), Some(ours)) => {
                mark.codes.iter_mut().for_each(|code| *code *= own / ours);
                stage
            }
            _ => stage,
        };
        let number =
            |name: &str, fallback: f64| info::<f64>(&stage, name).map(|value| value.unwrap_or(fallback));
        let start = number("startTimeCode", 0.0).map_err(failed)?;
        let end = number("endTimeCode", start).map_err(failed)?;
        let last =
            |codes: &[f64], otherwise: f64| codes.last().copied().unwrap_or(otherwise).max(0.0) as usize;
        let reading = Reading {
            pxr,
            path,
            arrays: Arrays::new(pxr, bytes).map_err(failed)?,
            frames: Frames::new(pxr, &stage, &mark.frame).map_err(failed)?,
            start: mark.codes.first().copied().unwrap_or(start),
            source_frames: (
                mark.codes.first().copied().unwrap_or(start).max(0.0) as usize,
                last(&mark.codes, end),
            ),
            has_windows: mark.windows > 1,
            warnings: RefCell::default(),
        };
        match reading.has_windows {
            false => read(&reading, &stage, mark),
            true => windows::read(pxr, &stage, failed, || read(&reading, &stage, mark.clone())),
        }
    })
}

/// A word on what a stage without splats draws.
fn what_else(stage: &Bound<'_, PyAny>) -> PyResult<String> {
    /// Types that draw nothing by themselves.
    const SILENT: [&str; 6] = ["", "Xform", "Scope", "Camera", "Material", "Shader"];
    let mut types = BTreeSet::new();
    for prim in stage.call_method0("Traverse")?.try_iter()? {
        types.insert(prim?.call_method0("GetTypeName")?.str()?.to_string());
    }
    if types.iter().any(|name| name.starts_with("OmniNuRec")) {
        return Ok("; its volumes are NuRec's, whose splats USD does not describe: export them as \
                   ParticleField3DGaussianSplat, or as .ply"
            .to_owned());
    }
    let drawn: Vec<&str> = types.iter().map(String::as_str).filter(|name| !SILENT.contains(name)).collect();
    Ok(if drawn.is_empty() { String::new() } else { format!("; it has prims of type {}", drawn.join(", ")) })
}

fn read<'py>(
    reading: &Reading<'_, 'py>,
    stage: &Bound<'py, PyAny>,
    mark: Mark,
) -> Result<SceneGraph, UsdError> {
    let failed = |error: PyErr| reading.python(&error);
    let (owners, camera_prims) = survey(reading, stage).map_err(failed)?;
    if owners.is_empty() {
        let found = what_else(stage).map_err(failed)?;
        return Err(UsdError::NoSplats { path: reading.path.to_owned(), found });
    }
    let prims: Vec<Prim> =
        owners.iter().map(|owner| nodes::read(reading, owner)).collect::<Result<_, _>>()?;
    let mut cameras = Vec::with_capacity(camera_prims.len());
    for prim in &camera_prims {
        cameras.extend(cameras::read(reading, prim).map_err(failed)?);
    }
    let text_info = |name: &str| info::<String>(stage, name).map_err(failed);
    let up_axis = match text_info("upAxis")?.as_deref() {
        Some("Z") => UpAxis::Z,
        _ => UpAxis::Y,
    };
    // 0.01 is USD's own fallback.
    let meters_per_unit = info::<f64>(stage, "metersPerUnit").map_err(failed)?.unwrap_or(0.01);
    if !(meters_per_unit.is_finite() && meters_per_unit > 0.0) {
        let problem = format!("metersPerUnit is {meters_per_unit}");
        return Err(reading.prim_error("/", problem, "set it to the metres of one unit, for example 1"));
    }
    // As USD plays it: the time codes per second that it says, else its frames per second, else 24.
    let rate: f64 =
        stage.call_method0("GetTimeCodesPerSecond").and_then(|rate| rate.extract()).map_err(failed)?;
    let frames_per_second = if rate.is_finite() && rate > 0.0 { rate } else { FRAMES_PER_SECOND };
    let sort = match &mark.sort {
        Some(sort) => Some(sort.clone()),
        None => plain(&owners[0].splats[0].prim, "sortingModeHint", &reading.pxr.earliest().map_err(failed)?)
            .map_err(failed)?,
    };
    let timeline = match !mark.codes.is_empty() && mark.codes.len() == mark.times.len() {
        true => Timeline::Recorded(TimeCodes { samples: mark.codes, times: mark.times, frames_per_second }),
        false => Timeline::Sampled { codes: Vec::new(), start: reading.start, frames_per_second },
    };
    let mut warnings = mark.warnings;
    warnings.extend(reading.warnings.take());
    let scene = Prims {
        up_axis,
        meters_per_unit,
        frame: mark.frame,
        timeline,
        prims,
        cameras,
        background_color: mark.background,
        sort_metric: match sort.as_deref() {
            Some(tokens::SORT_CAMERA_DISTANCE) => SortMetric::Distance,
            _ => SortMetric::Z,
        },
        antialiased: mark.antialiased,
        omitted: mark.omitted,
        warnings,
        origin: mark.origin,
        ..Prims::default()
    };
    assemble(scene).map_err(|AssembleError { place, what }| {
        reading.prim_error(&place, what.to_owned(), "write them into several stages")
    })
}

/// Layers whose opinions count for the stage itself, strongest first.
fn layers<'py>(stage: &Bound<'py, PyAny>) -> PyResult<Vec<Bound<'py, PyAny>>> {
    stage.call_method1("GetLayerStack", (false,))?.try_iter()?.collect()
}

/// Metadata of the strongest layer that has it. USD itself looks at the root layer only, but a layer of edits over
/// ours need not repeat what ours says.
fn info<'py, T: for<'a> FromPyObject<'a, 'py>>(stage: &Bound<'py, PyAny>, name: &str) -> PyResult<Option<T>> {
    for layer in layers(stage)? {
        let root = layer.getattr("pseudoRoot")?;
        if root.call_method1("HasInfo", (name,))?.is_truthy()? {
            return Ok(root.call_method1("GetInfo", (name,))?.extract().ok());
        }
    }
    Ok(None)
}

/// Time codes per second that a layer gives itself.
fn rate(layer: &Bound<'_, PyAny>) -> PyResult<Option<f64>> {
    let authored = |name: &str| layer.call_method0(name).and_then(|has| has.is_truthy());
    let rate = if authored("HasTimeCodesPerSecond")? {
        layer.getattr("timeCodesPerSecond")?.extract()?
    } else if authored("HasFramesPerSecond")? {
        layer.getattr("framesPerSecond")?.extract()?
    } else {
        return Ok(None);
    };
    Ok(Some(rate).filter(|rate: &f64| rate.is_finite() && *rate > 0.0))
}

/// Our mark on the strongest layer that has it.
fn mark(stage: &Bound<'_, PyAny>) -> PyResult<Mark> {
    for layer in layers(stage)? {
        let data = layer.getattr("customLayerData")?;
        if !data.contains(tokens::CIF)? {
            continue;
        }
        let ours = data.get_item(tokens::CIF)?;
        let get = |key: &str| -> PyResult<Option<Bound<'_, PyAny>>> {
            if ours.contains(key)? { ours.get_item(key).map(Some) } else { Ok(None) }
        };
        let string =
            |key: &str| -> PyResult<Option<String>> { Ok(get(key)?.and_then(|value| value.extract().ok())) };
        let list = |key: &str| -> PyResult<Vec<Bound<'_, PyAny>>> {
            match get(key)? {
                Some(values) => values.try_iter()?.collect(),
                None => Ok(Vec::new()),
            }
        };
        let numbers =
            |key: &str| -> PyResult<Vec<f64>> { list(key)?.iter().map(|value| value.extract()).collect() };
        let strings = |key: &str| -> PyResult<Vec<String>> { list(key)?.iter().map(text).collect() };
        let background = match get(tokens::BACKGROUND_COLOR)? {
            Some(color) => values::vector::<3>(&color)?.map(|channel| channel as f32),
            None => [0.0; 3],
        };
        let options = string(tokens::OPTIONS)?;
        let mut frame = CaptureFrame::default();
        if let Some(offset) = get(tokens::CAPTURE_OFFSET)? {
            frame.offset = values::vector(&offset)?;
        }
        if let Some(scale) = get(tokens::CAPTURE_SCALE)? {
            frame.scale = scale.extract()?;
        }
        return Ok(Mark {
            ours: true,
            rate: rate(&layer)?,
            generator: string(tokens::GENERATOR)?.unwrap_or_else(|| tokens::CIF.to_owned()),
            layout: get(tokens::LAYOUT)?.and_then(|layout| layout.extract().ok()).unwrap_or(0),
            times: numbers(tokens::SAMPLE_TIMES)?,
            codes: numbers(tokens::SAMPLE_CODES)?,
            background,
            omitted: strings(tokens::OMITTED)?,
            warnings: strings(tokens::WARNINGS)?,
            windows: get(tokens::WINDOWS)?.and_then(|windows| windows.extract().ok()).unwrap_or(0),
            sort: string(tokens::SORT)?,
            antialiased: get(tokens::ANTIALIASED)?.and_then(|value| value.extract().ok()),
            frame,
            origin: Origin {
                field_fingerprint: string(tokens::FIELD_FINGERPRINT)?,
                options: options.and_then(|text| serde_json::from_str::<SceneOptions>(&text).ok()),
            },
        });
    }
    Ok(Mark::default())
}

/// Prims that become nodes, in stage order, and cameras.
fn survey<'py>(
    reading: &Reading<'_, 'py>,
    stage: &Bound<'py, PyAny>,
) -> PyResult<(Vec<Owner<'py>>, Vec<Bound<'py, PyAny>>)> {
    let pxr = reading.pxr;
    let (mut found, mut cameras) = (Vec::new(), Vec::new());
    // Prototypes below a point instancer are not drawn where they stand.
    let mut instancer: Option<String> = None;
    for prim in labels::all_prims(pxr, stage, Instances::Each)? {
        let prim = prim?;
        let path = values::path(&prim)?;
        if instancer.as_ref().is_some_and(|above| path.starts_with(above.as_str())) {
            continue;
        }
        let type_name = text(&prim.call_method0("GetTypeName")?)?;
        if type_name == "PointInstancer" {
            // Stand-ins of ours are one: their points carry the splats that they stand for.
            let points = prim.call_method1("GetPrimAtPath", (tokens::PROXY_POINTS,))?;
            let stands_in =
                points.is_truthy()? && values::attribute(&points, tokens::PRIMVAR_SPLAT)?.is_some();
            if !stands_in {
                reading.warn(format!(
                    "{path}: copies made by a point instancer are not read; turn them into prims with references"
                ));
            }
            instancer = Some(format!("{path}/"));
        } else if type_name == "Camera" {
            cameras.push(prim);
        } else if type_name == tokens::GAUSSIAN_SPLAT {
            let purpose =
                pxr.usd_geom.getattr("Imageable")?.call1((&prim,))?.call_method0("ComputePurpose")?;
            let purpose = text(&purpose)?;
            let splats = SplatPrim { path, prim };
            if [tokens::PURPOSE_PROXY, tokens::PURPOSE_GUIDE].contains(&purpose.as_str()) {
                reading.warn(format!("{}: its purpose is {purpose}, so that it is not read", splats.path));
            } else if splats.has_positions()? {
                found.push(splats);
            } else {
                reading.warn(format!("{}: no positions, left out", splats.path));
            }
        }
    }
    let single = found.len() == 1;
    let mut owners: Vec<Owner<'py>> = Vec::new();
    let mut places: BTreeMap<String, usize> = BTreeMap::new();
    for splats in found {
        let (prim, recorded) = owner_of(pxr, &splats.prim, single)?;
        let path = values::path(&prim)?;
        let place = *places.entry(path.clone()).or_insert(owners.len());
        if place == owners.len() {
            owners.push(Owner { prim, path, recorded, splats: Vec::new() });
        }
        owners[place].splats.push(splats);
    }
    for owner in &mut owners {
        if owner.splats.len() > 1 {
            let mut numbered = Vec::with_capacity(owner.splats.len());
            for splats in owner.splats.drain(..) {
                let carrier = splats.carrier(&owner.prim)?;
                let index: Option<i64> = plain(&carrier, tokens::PART_INDEX, &pxr.earliest()?)?;
                numbered.push((index.unwrap_or(i64::MAX), splats));
            }
            numbered.sort_by_key(|(index, _)| *index);
            owner.splats.extend(numbered.into_iter().map(|(_, splats)| splats));
        }
    }
    Ok((owners, cameras))
}

/// The prim that a splat prim belongs to: with our schema, else with labels, else a component, else itself.
fn owner_of<'py>(
    pxr: &Pxr<'py>,
    splats: &Bound<'py, PyAny>,
    single: bool,
) -> PyResult<(Bound<'py, PyAny>, Recorded)> {
    let mut chain = Vec::new();
    let mut at = splats.clone();
    while at.is_truthy()? && !at.call_method0("IsPseudoRoot")?.is_truthy()? {
        chain.push(at.clone());
        at = at.call_method0("GetParent")?;
    }
    for prim in &chain {
        if let Some(recorded) = labels::recorded(pxr, prim)? {
            return Ok((prim.clone(), recorded));
        }
    }
    for prim in &chain {
        if !labels::taxonomies(prim)?.is_empty() {
            return Ok((prim.clone(), Recorded::default()));
        }
    }
    for prim in &chain {
        let kind = pxr.usd.getattr("ModelAPI")?.call1((prim,))?.call_method0("GetKind")?;
        if matches!(text(&kind)?.as_str(), "component" | "subcomponent") {
            return Ok((prim.clone(), Recorded::default()));
        }
    }
    // A plain scan is no object.
    Ok((splats.clone(), Recorded { background: single, ..Recorded::default() }))
}
