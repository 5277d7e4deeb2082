//! Where prims are over time: exact tracks where the operations are ours, sampled ones otherwise.

use std::cell::RefCell;
use std::collections::BTreeMap;

use cif_scene::assemble::{Decomposed, Placement, Track, is_identity, one_hemisphere};
use cif_scene::{CaptureFrame, PoseSample, world};
use glam::{DAffine3, DQuat, DVec3};
use pyo3::prelude::*;

use super::values;
use crate::pxr::Pxr;
use crate::tokens;

/// Most time codes that a track is sampled at between its keys.
const MOST_FRAMES: f64 = 10_000.0;

/// Transforms of a stage: from prims to the scene's own frame, which is the world unless the export placed it there.
pub(super) struct Frames<'a, 'py> {
    pxr: &'a Pxr<'py>,
    /// Transform from the world to the scene's frame; `None` where they are one.
    scene_from_world: Option<DAffine3>,
    /// The prim that places the scene, while it does so as exported.
    root: Option<Bound<'py, PyAny>>,
    caches: RefCell<BTreeMap<u64, Bound<'py, PyAny>>>,
}

/// Operations of one prim.
enum Operations<'py> {
    /// It stays in its parent's frame.
    None,
    /// `translate` and `orient`, as we write them.
    Pose { translate: Bound<'py, PyAny>, orient: Bound<'py, PyAny> },
    /// Anything else.
    Other,
}

impl<'a, 'py> Frames<'a, 'py> {
    /// `frame` is where the export placed the scene.
    pub(super) fn new(pxr: &'a Pxr<'py>, stage: &Bound<'py, PyAny>, frame: &CaptureFrame) -> PyResult<Self> {
        let mut frames = Self { pxr, scene_from_world: None, root: None, caches: RefCell::default() };
        if frame.is_identity() {
            return Ok(frames);
        }
        let placed = world::world_from_graph(frame);
        let root = stage.call_method1("GetPrimAtPath", (tokens::WORLD,))?;
        if root.is_truthy()? && frames.keys(&root)?.is_empty() && frames.world(&root, None)? == placed {
            frames.root = Some(root);
        }
        frames.scene_from_world = Some(placed.inverse());
        frames.caches.take();
        Ok(frames)
    }

    /// True when a prim only places the scene in the world, as exported.
    fn is_root(&self, prim: &Bound<'py, PyAny>) -> PyResult<bool> {
        self.root.as_ref().map_or(Ok(false), |root| root.eq(prim))
    }

    fn operations(&self, prim: &Bound<'py, PyAny>) -> PyResult<Operations<'py>> {
        if self.is_root(prim)? {
            return Ok(Operations::None);
        }
        let xformable = self.pxr.usd_geom.getattr("Xformable")?.call1((prim,))?;
        if !xformable.is_truthy()? {
            return Ok(Operations::None);
        }
        let resets = xformable.call_method0("GetResetXformStack")?.is_truthy()?;
        let ops: Vec<Bound<'py, PyAny>> = xformable.call_method0("GetOrderedXformOps")?.extract()?;
        let names: Vec<String> =
            ops.iter().map(|op| values::text(&op.call_method0("GetOpName")?)).collect::<PyResult<_>>()?;
        match (&ops[..], resets) {
            ([], false) => Ok(Operations::None),
            ([translate, orient], false) if names == ["xformOp:translate", "xformOp:orient"] => {
                let translate = translate.call_method0("GetAttr")?;
                let orient = orient.call_method0("GetAttr")?;
                Ok(Operations::Pose { translate, orient })
            }
            _ => Ok(Operations::Other),
        }
    }

    /// Keys of a prim's own operations.
    fn keys(&self, prim: &Bound<'py, PyAny>) -> PyResult<Vec<f64>> {
        let xformable = self.pxr.usd_geom.getattr("Xformable")?.call1((prim,))?;
        if xformable.is_truthy()? {
            xformable.call_method0("GetTimeSamples")?.extract()
        } else {
            Ok(Vec::new())
        }
    }

    /// True when operations are sampled that are not interpolated as poses: all but `translate`, `scale`, `orient`.
    fn turns(&self, prim: &Bound<'py, PyAny>) -> PyResult<bool> {
        let xformable = self.pxr.usd_geom.getattr("Xformable")?.call1((prim,))?;
        for op in xformable.call_method0("GetOrderedXformOps")?.try_iter()? {
            let op = op?;
            let name = values::text(&op.call_method0("GetOpName")?)?;
            let straight = ["translate", "scale", "orient"]
                .iter()
                .any(|kind| name.strip_prefix("xformOp:").is_some_and(|name| name.starts_with(kind)));
            if !straight && op.call_method0("GetNumTimeSamples")?.extract::<usize>()? > 1 {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Exact track of a prim in its parent's frame, where its operations are ours or none.
    fn exact(&self, operations: &Operations<'py>) -> PyResult<Option<Track>> {
        let (translate, orient) = match operations {
            Operations::None => return Ok(Some(Track::still())),
            Operations::Other => return Ok(None),
            Operations::Pose { translate, orient } => (translate, orient),
        };
        let mut times = values::samples(translate)?;
        times.extend(values::samples(orient)?);
        times.sort_by(f64::total_cmp);
        times.dedup();
        let at = |time: &Bound<'py, PyAny>, time_code: f64| -> PyResult<Option<PoseSample>> {
            let translation = translate.call_method1("Get", (time,))?;
            let rotation = orient.call_method1("Get", (time,))?;
            let translation = if translation.is_none() { DVec3::ZERO } else { values::vec3(&translation)? };
            let rotation = if rotation.is_none() { DQuat::IDENTITY } else { values::quaternion(&rotation)? };
            // Rounding to single precision is undone by nobody; anything worse is no rotation.
            let close = (rotation.length() - 1.0).abs() < 1e-3;
            Ok((close && translation.is_finite()).then_some(PoseSample { time_code, translation, rotation }))
        };
        let Some(rest) = at(&self.pxr.earliest()?, times.first().copied().unwrap_or(0.0))? else {
            return Ok(None);
        };
        let mut samples = Vec::with_capacity(times.len());
        for time_code in times {
            match at(&self.pxr.time_code(Some(time_code))?, time_code)? {
                Some(sample) => samples.push(sample),
                None => return Ok(None),
            }
        }
        Ok(Some(Track { rest, samples }))
    }

    /// `scene_from_prim`; the earliest time for `None`.
    pub(super) fn world(&self, prim: &Bound<'py, PyAny>, time: Option<f64>) -> PyResult<DAffine3> {
        let key = time.map_or(u64::MAX, f64::to_bits);
        let known = self.caches.borrow().get(&key).cloned();
        let cache = match known {
            Some(cache) => cache,
            None => {
                let time = match time {
                    Some(time) => self.pxr.time_code(Some(time))?,
                    None => self.pxr.earliest()?,
                };
                let cache = self.pxr.usd_geom.getattr("XformCache")?.call1((time,))?;
                self.caches.borrow_mut().insert(key, cache.clone());
                cache
            }
        };
        let matrix = values::matrix(&cache.call_method1("GetLocalToWorldTransform", (prim,))?)?;
        let world = DAffine3::from_mat4(matrix);
        Ok(self.scene_from_world.map_or(world, |scene_from_world| scene_from_world * world))
    }

    /// Prims from `prim` up to, but without, `end` or the root.
    fn chain(
        &self,
        prim: &Bound<'py, PyAny>,
        end: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Vec<Bound<'py, PyAny>>> {
        let mut chain = Vec::new();
        let mut at = prim.clone();
        loop {
            let stop = match end {
                Some(end) => at.eq(end)?,
                None => at.call_method0("IsPseudoRoot")?.is_truthy()?,
            };
            if stop || !at.is_truthy()? || at.call_method0("IsPseudoRoot")?.is_truthy()? {
                return Ok(chain);
            }
            chain.push(at.clone());
            at = at.call_method0("GetParent")?;
        }
    }

    /// Exact track of `prim` in the frame of `end` (that of the scene for `None`), where only one prim between them
    /// has operations, and those are ours.
    fn exact_between(
        &self,
        prim: &Bound<'py, PyAny>,
        end: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Option<Track>> {
        let chain = self.chain(prim, end)?;
        if end.is_none() && self.scene_from_world.is_some() {
            // What stands next to our root, or below it where it was moved, is seen from the world.
            let top = chain.last().map_or(Ok(false), |top| self.is_root(top))?;
            if !top {
                return Ok(None);
            }
        }
        let mut found = None;
        for prim in chain {
            let operations = self.operations(&prim)?;
            match operations {
                Operations::None => {}
                _ if found.is_some() => return Ok(None),
                _ => found = Some(operations),
            }
        }
        self.exact(&found.unwrap_or(Operations::None))
    }

    /// Times at which anything between a prim and `end` is sampled. Motion that is not linear between its keys is
    /// sampled at every frame too.
    fn times(&self, prim: &Bound<'py, PyAny>, end: Option<&Bound<'py, PyAny>>) -> PyResult<Vec<f64>> {
        let (mut times, mut movers, mut bent) = (Vec::new(), 0, false);
        for prim in self.chain(prim, end)? {
            let keys = self.keys(&prim)?;
            if keys.len() > 1 {
                movers += 1;
                bent |= self.turns(&prim)?;
            }
            times.extend(keys);
        }
        times.sort_by(f64::total_cmp);
        times.dedup();
        if let (Some(&first), Some(&last)) = (times.first(), times.last())
            && (movers > 1 || bent)
        {
            let (first, last) = (first.ceil(), last.floor());
            if last - first <= MOST_FRAMES {
                let mut frame = first;
                while frame <= last {
                    times.push(frame);
                    frame += 1.0;
                }
                times.sort_by(f64::total_cmp);
                times.dedup();
            }
        }
        Ok(times)
    }

    /// Track of a prim's frame in that of the scene, without what is not rigid in it; `None` where it collapses.
    pub(super) fn node(&self, prim: &Bound<'py, PyAny>) -> PyResult<Option<(Track, bool)>> {
        if let Some(track) = self.exact_between(prim, None)? {
            return Ok(Some((track, true)));
        }
        let Some(first) = Decomposed::of(&self.world(prim, None)?) else { return Ok(None) };
        let times = self.times(prim, None)?;
        let rest = first.pose(times.first().copied().unwrap_or(0.0));
        let mut samples = Vec::with_capacity(times.len());
        for &time in &times {
            let Some(world) = Decomposed::of(&self.world(prim, Some(time))?) else { return Ok(None) };
            samples.push(world.pose(time));
        }
        one_hemisphere(&mut samples);
        let moves = samples
            .iter()
            .any(|sample| sample.translation != rest.translation || sample.rotation != rest.rotation);
        if !moves {
            samples.clear();
        }
        Ok(Some((Track { rest, samples }, false)))
    }

    /// Transform from a splat prim to the frame of its node; `None` where it collapses. `exact` says whether the
    /// track is that of the owner without loss.
    pub(super) fn placement(
        &self,
        prim: &Bound<'py, PyAny>,
        owner: &Bound<'py, PyAny>,
        track: &Track,
        exact: bool,
    ) -> PyResult<Option<Placement>> {
        if exact && let Some(track) = self.exact_between(prim, Some(owner))? {
            return Ok(Some(Placement::Rigid { track, baked: None }));
        }
        let local = |time: Option<f64>| -> PyResult<Option<(DAffine3, Decomposed)>> {
            let PoseSample { translation, rotation, .. } = time.map_or(track.rest, |time| track.at(time));
            let owner = DAffine3::from_rotation_translation(rotation, translation);
            let map = owner.inverse() * self.world(prim, time)?;
            Ok(Decomposed::of(&map).map(|parts| (map, parts)))
        };
        let Some((first, rest)) = local(None)? else { return Ok(None) };
        let mut samples = Vec::new();
        for time in self.times(prim, None)? {
            let Some((map, parts)) = local(Some(time))? else { return Ok(None) };
            samples.push((time, map, parts));
        }
        let same = |a: &DAffine3, b: &DAffine3| {
            let scale = 1.0 + a.translation.length();
            is_identity(&(a.matrix3.inverse() * b.matrix3))
                && (a.translation - b.translation).length() < 1e-6 * scale
        };
        if samples.iter().all(|(_, map, _)| same(&first, map)) {
            let identity = is_identity(&first.matrix3) && first.translation.length() < 1e-12;
            return Ok(Some(Placement::still((!identity).then_some(first))));
        }
        if samples.iter().all(|(.., parts)| is_identity(&(rest.stretch.inverse() * parts.stretch))) {
            let mut poses: Vec<PoseSample> =
                samples.iter().map(|(time, _, parts)| parts.pose(*time)).collect();
            one_hemisphere(&mut poses);
            let baked = (!is_identity(&rest.stretch)).then(|| DAffine3::from_mat3(rest.stretch));
            let track = Track { rest: rest.pose(samples[0].0), samples: poses };
            return Ok(Some(Placement::Rigid { track, baked }));
        }
        Ok(Some(Placement::Sampled(samples.into_iter().map(|(time, map, _)| (time, map)).collect())))
    }
}
