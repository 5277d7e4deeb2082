//! Origin of a field, and the settings by which a renderer shows it as it was trained.
//!
//! In a file the record is the JSON object `provenance`. Facts that programs act on have types here; everything else
//! is kept as [`Record::notes`], which people read and no behaviour depends on. Files of older versions have the same
//! facts at other keys (near plane and antialiasing among the settings, exposures in the run) and are read into the
//! same record.

use std::collections::BTreeMap;

use cif_geometry::{CaptureFrame, TimeWindow, UpAxis};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::{Embeddings, Exposure, TimedExposure};

/// Origin of a field, and the settings by which a renderer shows it as it was trained.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Record {
    /// Near plane, antialiasing, occupancy and exposures of the renderer.
    pub drawing: Drawing,
    /// Where its coordinates lie in the world of its capture, or of the file that it was imported from.
    pub frame: CaptureFrame,
    /// Unit and up axis that the file declared that it was imported from; exports declare the same.
    pub declared: Option<Declared>,
    /// Time codes of its frames in that file, or in the capture that it is a window of; `None` where frame `f` is time
    /// code `f`.
    pub frame_codes: Option<FrameCodes>,
    /// Name of the capture that it was trained on.
    pub capture: Option<String>,
    /// Window of time of that capture; `None` for all of it.
    pub window: Option<TimeWindow>,
    /// A sentence on what is not known of the world of that capture, its unit or its up axis; exports warn with it.
    pub unknown: Option<String>,
    /// The run that trained it.
    pub run: Option<Run>,
    /// Settings of the run, for information and as the base of other runs.
    pub settings: Option<Value>,
    /// Images that its Gaussians were trained on, as the trainer knows them again.
    pub images: Option<Value>,
    /// Quality over the steps of the run, as the trainer measured it.
    pub curve: Option<Value>,
    /// Appearance of its instances, where a model has looked at them.
    pub embeddings: Option<Embeddings>,
    /// Edits that were brought home from exported files, oldest first.
    pub edits: Vec<Value>,
    /// Everything else: versions, counts of the capture, the imported file. No behaviour reads it.
    pub notes: Map<String, Value>,
}

/// Unit and up axis of the world of a file.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Declared {
    /// Which axis points up.
    pub up_axis: UpAxis,
    /// Metres per world unit; above 0.
    pub meters_per_unit: f64,
}

/// Time codes of the frames of a field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum FrameCodes {
    /// That of frame 0; one more for every further frame.
    From(f64),
    /// One per frame, ascending.
    Each(Vec<f64>),
}

impl FrameCodes {
    /// The shortest form of the codes; `None` where frame `f` is time code `f`.
    #[must_use]
    pub fn of(codes: &[f64]) -> Option<Self> {
        let first = codes.first().copied().filter(|first| first.is_finite())?;
        let even = codes.iter().enumerate().all(|(frame, code)| *code == first + frame as f64);
        match (even, first == 0.0) {
            (true, true) => None,
            (true, false) => Some(Self::From(first)),
            (false, _) => Some(Self::Each(codes.to_vec())),
        }
    }

    /// One time code per frame; `None` where these do not fit to so many frames.
    pub(crate) fn codes(&self, frames: usize) -> Option<Vec<f64>> {
        match self {
            Self::From(first) => Some((0..frames).map(|frame| first + frame as f64).collect()),
            Self::Each(codes) => Some(codes.clone()).filter(|codes| codes.len() == frames),
        }
    }

    fn is_valid(&self) -> bool {
        match self {
            Self::From(first) => first.is_finite(),
            Self::Each(codes) => {
                codes.iter().all(|code| code.is_finite()) && codes.windows(2).all(|pair| pair[0] < pair[1])
            }
        }
    }
}

/// Settings by which a renderer shows a field as it was trained.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Drawing {
    /// Distance of the near plane, world units; `None` for the renderer's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub near: Option<f32>,
    /// True when footprints are widened and their opacity lowered in turn; `None` for the renderer's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub antialiased: Option<bool>,
    /// True when the opacity takes the place of the occupancy.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub opacity_is_occupancy: bool,
    /// Exposure of every camera; empty where all record them as they are.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub exposures: BTreeMap<String, Exposure>,
    /// Exposures of cameras that record otherwise from time to time, in the order of times.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub exposures_in_time: BTreeMap<String, Vec<TimedExposure>>,
}

impl Drawing {
    /// Exposure of a camera at a time; `None` of a camera whose exposure is not known.
    #[must_use]
    pub fn exposure(&self, camera: &str, time: f64) -> Option<Exposure> {
        match self.exposures_in_time.get(camera) {
            Some(series) => TimedExposure::at(series, time),
            None => self.exposures.get(camera).copied(),
        }
    }

    /// True where exposures of cameras are known.
    #[must_use]
    pub fn has_exposures(&self) -> bool {
        !self.exposures.is_empty() || !self.exposures_in_time.is_empty()
    }
}

/// A training run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Run {
    /// True when all stages were run.
    pub complete: bool,
    /// Name of the preset.
    pub preset: Option<String>,
    /// Seed of all random numbers.
    pub seed: Option<u64>,
    /// Steps over all stages.
    pub iterations: Option<u64>,
    /// Time of the run on the clock, seconds; of the steps alone in scenes of older versions.
    pub wall_s: Option<f64>,
    /// The same per phase.
    #[serde(alias = "wall_s_by_stage")]
    pub wall_s_by_phase: BTreeMap<String, f64>,
    /// Processor time of the run, all threads together, seconds.
    pub cpu_s: Option<f64>,
    /// Largest resident memory, MB; `None` where the system did not tell.
    pub peak_rss_mb: Option<f64>,
    /// Everything else about the run. No behaviour reads it.
    #[serde(flatten)]
    pub notes: Map<String, Value>,
}

/// Why a record cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The scene lies nowhere.
    #[error("the frame of the capture is recorded as {found}; train the scene again")]
    Frame {
        /// The recorded value.
        found: String,
    },
}

const CAPTURE: &str = "dataset";
const IMPORTED: &str = "imported";
const RUN: &str = "train";
const SETTINGS: &str = "config";
const IMAGES: &str = "images";
const CURVE: &str = "curve";
const EDITS: &str = "edits";
const DRAWING: &str = "drawing";
const EMBEDDINGS: &str = "embeddings";
const NAME: &str = "name";
const FRAME: &str = "frame";
const UP_AXIS: &str = "up_axis";
const UNIT: &str = "meters_per_unit";
const TIME_CODES: &str = "time_codes";
const WINDOW: &str = "window";
const UNKNOWN: &str = "unknown";
const EXPOSURES: &str = "exposures";

impl Record {
    /// Reads the JSON of this version or of an older one. Values of another type than expected stay notes, except for
    /// frames, which nobody may guess.
    ///
    /// # Errors
    /// A frame that places the field nowhere.
    pub fn from_json(json: Value) -> Result<Self, RecordError> {
        let mut notes = match json {
            Value::Object(notes) => notes,
            Value::Null => return Ok(Self::default()),
            // Nobody wrote such records, but files may hold anything here.
            other => Map::from_iter([("note".to_owned(), other)]),
        };
        let mut record = Self { frame: take_frame(&mut notes)?, ..Self::default() };
        let capture = notes.get_mut(CAPTURE).and_then(Value::as_object_mut);
        if let Some(of) = capture {
            (record.capture, record.unknown) = (take(of, NAME), take(of, UNKNOWN));
            record.window = take(of, WINDOW);
            record.frame_codes = take(of, TIME_CODES).filter(FrameCodes::is_valid);
        }
        let imported = notes.get(IMPORTED);
        let of_file = imported.and_then(|of| serde_json::from_value::<Declared>(of.clone()).ok());
        record.declared = of_file.filter(|of| of.meters_per_unit.is_finite() && of.meters_per_unit > 0.0);
        let codes = imported.and_then(|of| of.get(TIME_CODES)).cloned();
        let codes = codes.and_then(|codes| serde_json::from_value(codes).ok());
        record.frame_codes = codes.filter(FrameCodes::is_valid).or(record.frame_codes);
        if let Some(imported) = notes.get_mut(IMPORTED).and_then(Value::as_object_mut) {
            let typed = [
                (record.declared.is_some(), &[UP_AXIS, UNIT][..]),
                (record.frame_codes.is_some(), &[TIME_CODES]),
            ];
            for (_, keys) in typed.into_iter().filter(|(is_typed, _)| *is_typed) {
                keys.iter().for_each(|key| drop(imported.remove(*key)));
            }
        }
        record.run = take(&mut notes, RUN);
        record.settings = notes.remove(SETTINGS);
        record.images = notes.remove(IMAGES);
        record.curve = notes.remove(CURVE);
        record.edits = take(&mut notes, EDITS).unwrap_or_default();
        if let Some(embeddings) = take::<Embeddings>(&mut notes, EMBEDDINGS) {
            match embeddings.is_valid() {
                true => record.embeddings = Some(embeddings),
                // Nobody can compare with these.
                false => drop(notes.insert(EMBEDDINGS.to_owned(), json!(embeddings))),
            }
        }
        record.drawing = match take(&mut notes, DRAWING) {
            Some(drawing) => drawing,
            None => drawing_of_older_files(record.settings.as_ref(), record.run.as_mut()),
        };
        notes.retain(|_, value| value.as_object().is_none_or(|members| !members.is_empty()));
        record.notes = notes;
        Ok(record)
    }

    /// The record as JSON object.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let mut json = self.notes.clone();
        let place = if (json.contains_key(IMPORTED) || self.declared.is_some()) && !json.contains_key(CAPTURE)
        {
            IMPORTED
        } else {
            CAPTURE
        };
        let mut put = |object: &str, key: &str, value: Value| {
            if let Value::Object(members) = json.entry(object).or_insert_with(|| json!({})) {
                members.insert(key.to_owned(), value);
            }
        };
        if let Some(name) = &self.capture {
            put(CAPTURE, NAME, json!(name));
        }
        if let Some(window) = self.window {
            put(CAPTURE, WINDOW, json!(window));
        }
        if let Some(sentence) = &self.unknown {
            put(CAPTURE, UNKNOWN, json!(sentence));
        }
        if !self.frame.is_identity() {
            put(place, FRAME, json!(self.frame));
        }
        if let Some(declared) = self.declared {
            put(IMPORTED, UP_AXIS, json!(declared.up_axis));
            put(IMPORTED, UNIT, json!(declared.meters_per_unit));
        }
        if let Some(codes) = &self.frame_codes {
            put(place, TIME_CODES, json!(codes));
        }
        let run = self.run.as_ref().map(|run| json!(run));
        let edits = (!self.edits.is_empty()).then(|| json!(self.edits));
        let drawing = (self.drawing != Drawing::default()).then(|| json!(self.drawing));
        let members = [
            (RUN, run),
            (SETTINGS, self.settings.clone()),
            (IMAGES, self.images.clone()),
            (CURVE, self.curve.clone()),
            (EDITS, edits),
            (EMBEDDINGS, self.embeddings.as_ref().map(|embeddings| json!(embeddings))),
            (DRAWING, drawing),
        ];
        json.extend(members.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value?))));
        Value::Object(json)
    }
}

/// Takes a member where it has a type; others stay.
fn take<T: DeserializeOwned>(object: &mut Map<String, Value>, key: &str) -> Option<T> {
    let value = serde_json::from_value(object.get(key)?.clone()).ok()?;
    object.remove(key);
    Some(value)
}

/// The frame of the capture, else that of the imported file.
fn take_frame(notes: &mut Map<String, Value>) -> Result<CaptureFrame, RecordError> {
    for key in [CAPTURE, IMPORTED] {
        let members = notes.get_mut(key).and_then(Value::as_object_mut);
        let Some(found) = members.and_then(|members| members.remove(FRAME)).filter(|found| !found.is_null())
        else {
            continue;
        };
        let frame = serde_json::from_value::<CaptureFrame>(found.clone()).ok().filter(CaptureFrame::is_valid);
        return frame.ok_or_else(|| RecordError::Frame { found: found.to_string() });
    }
    Ok(CaptureFrame::default())
}

/// Until version 0.1 files stated how to draw them in the settings of the run, and exposures next to its times.
fn drawing_of_older_files(settings: Option<&Value>, run: Option<&mut Run>) -> Drawing {
    let setting = |pointer: &str| settings.and_then(|settings| settings.pointer(pointer));
    let ablations = setting("/instance/ablate").and_then(Value::as_array);
    Drawing {
        near: setting("/near").and_then(Value::as_f64).map(|near| near as f32),
        antialiased: setting("/antialiased").and_then(Value::as_bool),
        opacity_is_occupancy: ablations.is_some_and(|names| names.contains(&json!("opacity-occupancy"))),
        exposures: run.and_then(|run| take(&mut run.notes, EXPOSURES)).unwrap_or_default(),
        exposures_in_time: BTreeMap::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the trainer wrote it before there were typed records.
    fn older() -> Value {
        json!({
            "generator": { "name": "cif", "version": "0.1.0" },
            "dataset": {
                "name": "table", "layout": "nerfstudio", "frames": 40, "masks": "masks",
                "frame": { "offset": [3e6, -2e5, 14.5], "scale": 0.001 },
            },
            "train": {
                "complete": true, "preset": "draft", "seed": 3, "iterations": 720, "wall_s": 61.5,
                "iterations_by_stage": { "coarse": 200, "fine": 520 },
                "wall_s_by_stage": { "coarse": 21.5, "fine": 40.0 },
                "cpu_s": 180.5, "peak_rss_mb": null, "simd": "avx2",
                "exposures": { "left": { "gain": [1.25, 1.0, 1.0], "offset": [0.0, 0.5, 0.0] } },
            },
            "config": {
                "near": 0.25, "antialiased": true, "preset": "draft",
                "instance": { "ablate": ["no-resampling", "opacity-occupancy"] },
            },
            "curve": { "points": [] },
            "edits": [{ "file": "edited.usda", "objects": [] }],
        })
    }

    #[test]
    fn older_records_are_understood() {
        let record = Record::from_json(older()).unwrap();
        assert_eq!(record.frame, CaptureFrame { offset: [3e6, -2e5, 14.5], scale: 0.001 });
        assert_eq!(record.capture.as_deref(), Some("table"));
        let Drawing { near, antialiased, opacity_is_occupancy, exposures, .. } = &record.drawing;
        assert_eq!((*near, *antialiased, *opacity_is_occupancy), (Some(0.25), Some(true), true));
        assert_eq!(exposures["left"].gain, [1.25, 1.0, 1.0]);
        let run = record.run.as_ref().unwrap();
        assert_eq!((run.iterations, run.wall_s, run.peak_rss_mb), (Some(720), Some(61.5), None));
        assert_eq!(run.wall_s_by_phase["fine"], 40.0, "as scenes of older versions have it");
        assert_eq!(run.notes["simd"], "avx2");
        assert_eq!(record.edits.len(), 1);
        assert_eq!(record.notes["dataset"]["layout"], "nerfstudio");
        assert!(record.notes["dataset"].get("name").is_none(), "nothing is there twice");
    }

    #[test]
    fn records_come_back_and_show_what_older_ones_showed() {
        let (older, record) = (older(), Record::from_json(older()).unwrap());
        let json = record.to_json();
        assert_eq!(Record::from_json(json.clone()).unwrap(), record);
        for key in ["generator", "dataset", "config", "curve", "edits"] {
            assert_eq!(json[key], older[key], "{key}");
        }
        for (key, value) in older["train"].as_object().unwrap() {
            let moved = match key.as_str() {
                "exposures" => &json["drawing"][key],
                "wall_s_by_stage" => &json["train"]["wall_s_by_phase"],
                _ => &json["train"][key],
            };
            assert_eq!(moved, value, "{key}");
        }
        assert_eq!(Record::from_json(Value::Null).unwrap().to_json(), json!({}));
        let unknown = Record { unknown: Some("its unit is not known".to_owned()), ..Record::default() };
        assert_eq!(Record::from_json(unknown.to_json()).unwrap(), unknown);
    }

    #[test]
    fn embeddings_come_back_exactly_and_wrong_ones_are_notes() {
        let direction: Vec<f32> = (1..=100).map(|k| (k as f32).sin()).collect();
        let length = direction.iter().map(|value| value * value).sum::<f32>().sqrt();
        let direction: Vec<f32> = direction.iter().map(|value| value / length).collect();
        let embeddings =
            Embeddings { model: "clip".to_owned(), of: [(3, direction), (40_000, vec![1.0])].into() };
        let record = Record { embeddings: Some(embeddings), ..Record::default() };
        let text = record.to_json().to_string();
        assert_eq!(Record::from_json(serde_json::from_str(&text).unwrap()).unwrap(), record);
        for wrong in [json!({ "model": "clip", "of": { "3": [2.0] } }), json!({ "of": 1 }), json!(7)] {
            let json = json!({ "embeddings": wrong });
            let read = Record::from_json(json.clone()).unwrap();
            assert_eq!(read.embeddings, None);
            assert_eq!(read.to_json(), json);
        }
    }

    #[test]
    fn what_the_new_key_says_counts() {
        let mut json = older();
        json["drawing"] = json!({ "near": 0.5 });
        let record = Record::from_json(json).unwrap();
        assert_eq!(record.drawing, Drawing { near: Some(0.5), ..Drawing::default() });
    }

    #[test]
    fn imported_scenes_keep_the_frame_of_their_file() {
        let frame = CaptureFrame { offset: [1.0, 2.0, 3.0], scale: 0.5 };
        let json = json!({ "imported": { "file": "a.usda", "frame": frame } });
        let record = Record::from_json(json.clone()).unwrap();
        assert_eq!(record.frame, frame);
        assert_eq!(record.to_json(), json);
    }

    #[test]
    fn unit_axis_and_time_codes_of_a_file_come_back() {
        let json = json!({ "imported": {
            "file": "a.usda", "up_axis": "y", "meters_per_unit": 0.01, "time_codes": 101.0,
        } });
        let record = Record::from_json(json.clone()).unwrap();
        assert_eq!(record.declared, Some(Declared { up_axis: UpAxis::Y, meters_per_unit: 0.01 }));
        assert_eq!(record.frame_codes, FrameCodes::of(&[101.0, 102.0]));
        assert_eq!(record.to_json(), json);
        let uneven = FrameCodes::of(&[0.0, 2.5, 4.0]).unwrap();
        assert_eq!((uneven.codes(3).unwrap(), uneven.codes(4)), (vec![0.0, 2.5, 4.0], None));
        assert_eq!(FrameCodes::of(&[0.0, 1.0]), None);
        let wrong =
            json!({ "imported": { "up_axis": "x", "meters_per_unit": -1.0, "time_codes": [2.0, 1.0] } });
        let record = Record::from_json(wrong.clone()).unwrap();
        assert_eq!((record.declared, record.frame_codes.clone()), (None, None));
        assert_eq!(record.to_json(), wrong, "stays a note");
    }

    #[test]
    fn windows_of_time_come_back() {
        let json = json!({ "dataset": { "name": "walk", "window": "2/4", "time_codes": 262.0 } });
        let record = Record::from_json(json.clone()).unwrap();
        assert_eq!(record.window, TimeWindow::new(2, 4));
        assert_eq!(record.frame_codes, FrameCodes::of(&[262.0, 263.0]));
        assert_eq!(record.to_json(), json);
        let wrong = json!({ "dataset": { "window": "5/4", "time_codes": "later" } });
        let record = Record::from_json(wrong.clone()).unwrap();
        assert_eq!((record.window, record.frame_codes.clone()), (None, None));
        assert_eq!(record.to_json(), wrong, "stays a note");
    }

    #[test]
    fn what_nobody_knows_is_kept_and_wrong_frames_are_refused() {
        let odd = json!({ "train": "yesterday", "made by": ["hand", 3], "edits": 7 });
        let record = Record::from_json(odd.clone()).unwrap();
        assert!(record.run.is_none() && record.edits.is_empty());
        assert_eq!(record.to_json(), odd);
        for wrong in [
            json!({ "offset": [0.0, 0.0], "scale": 1.0 }),
            json!({ "offset": [0.0, 0.0, 0.0], "scale": 0.0 }),
            json!("far"),
        ] {
            let message =
                Record::from_json(json!({ "dataset": { "frame": wrong } })).unwrap_err().to_string();
            assert!(message.contains("train the scene again"), "{message}");
        }
    }
}
