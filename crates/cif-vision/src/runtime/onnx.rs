//! Models run by ONNX Runtime on the processor.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::Part;
use super::place::Place;
use super::signature::{Bound, Side, bind};
use crate::models::{MANIFEST, Network};
use crate::{Error, Tensor};

/// A model with its tensors by part.
#[derive(Debug)]
pub(crate) struct Session {
    file: PathBuf,
    place: Place,
    inputs: Bound,
    outputs: Bound,
}

impl Session {
    /// Opens a model and finds the tensor of every part; `library` is that of ONNX Runtime.
    ///
    /// # Errors
    /// When the library or the model cannot be loaded, or a tensor is missing or does not fit.
    pub(crate) fn open(
        library: &Path,
        network: &Network,
        inputs: &[Part<'_>],
        outputs: &[Part<'_>],
    ) -> Result<Self, Error> {
        let mut place = Place::new()?;
        place.load_library(library).map_err(|problem| {
            Error::refused(
                format!("{} is no library of ONNX Runtime that fits: {problem}", library.display()),
                format!(
                    "pip install onnxruntime, or name another library (1.{} or newer) by {}",
                    ort::MINOR_VERSION,
                    crate::library::VARIABLE
                ),
            )
        })?;
        let file = network.model.clone();
        let [declared_inputs, declared_outputs] = place.open(&file).map_err(|problem| {
            Error::refused(
                format!("{} cannot be loaded: {problem}", file.display()),
                "give an ONNX model for the processor, with the files of its data next to it",
            )
        })?;
        let side = |word, declared, named, parts| Side { word, declared, named, parts };
        let inputs = bind(&file, side("input", &declared_inputs, &network.inputs, inputs))?;
        let outputs = bind(&file, side("output", &declared_outputs, &network.outputs, outputs))?;
        Ok(Self { file, place, inputs, outputs })
    }

    /// True where the model takes a part.
    pub(crate) fn has_input(&self, part: &str) -> bool {
        self.inputs.contains_key(part)
    }

    /// Lengths of the axes of an input, `None` where they vary; none where the model has no such part.
    pub(crate) fn input_shape(&self, part: &str) -> &[Option<usize>] {
        self.inputs.get(part).map_or(&[], |declared| &declared.shape)
    }

    /// An error about what came out as a part.
    pub(crate) fn refuse(&self, part: &str, problem: &str) -> Error {
        let name = self.outputs.get(part).map_or(part, |declared| &declared.name);
        Error::refused(
            format!("the output `{name}` of {}, which is `{part}`: {problem}", self.file.display()),
            format!("check the names of outputs in {MANIFEST}, and what the model was exported for"),
        )
    }

    /// Runs the model on the tensors of its parts, and gives those of its outputs that are named.
    ///
    /// # Errors
    /// When a tensor does not fit what the model declares, or the model fails.
    pub(crate) fn run(&mut self, given: Vec<(&str, Tensor)>) -> Result<BTreeMap<String, Tensor>, Error> {
        let file = self.file.display().to_string();
        let failed = |problem: String| {
            Error::refused(
                format!("{file} failed: {problem}"),
                "check that it is the model that models.toml says, exported for pictures of any size",
            )
        };
        let mut inputs: Vec<(String, Tensor)> = Vec::new();
        for (part, tensor) in given {
            let Some(declared) = self.inputs.get(part) else { continue };
            if !declared.takes(&tensor) {
                return Err(Error::refused(
                    format!(
                        "the input `{}` of {file} has the shape {}, and {:?} is given for `{part}`",
                        declared.name,
                        declared.shape_text(),
                        tensor.shape()
                    ),
                    "export the model with axes that vary, or for this shape",
                ));
            }
            inputs.push((declared.name.clone(), tensor));
        }
        if let Some(missing) =
            self.inputs.values().find(|one| !inputs.iter().any(|(name, _)| *name == one.name))
        {
            return Err(Error::refused(
                format!("nothing is given for the input `{}` of {file}", missing.name),
                format!("name its part in {MANIFEST} as an output of the model before it"),
            ));
        }
        let requested: Vec<String> = self.outputs.values().map(|declared| declared.name.clone()).collect();
        let outputs = self.place.run(inputs, &requested).map_err(failed)?;
        Ok(self.outputs.keys().cloned().zip(outputs).collect())
    }
}
