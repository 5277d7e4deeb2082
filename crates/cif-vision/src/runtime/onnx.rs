//! Models run by ONNX Runtime on the processor. Its library is loaded once per process, when the first model is opened.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ort::logging::LogLevel;
use ort::session::{Session as Model, SessionInputValue};
use ort::value::{Outlet, Tensor as Value, TensorElementType};

use super::Part;
use super::signature::{Bound, Declared, Element, Side, bind};
use crate::models::{MANIFEST, Network};
use crate::tensor::Values;
use crate::{Error, Tensor};

/// A model with its tensors by part.
#[derive(Debug)]
pub(crate) struct Session {
    file: PathBuf,
    model: Model,
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
        let environment = ort::init_from(library).map_err(|error| {
            Error::refused(
                format!("{} is no library of ONNX Runtime that fits: {error}", library.display()),
                format!(
                    "pip install onnxruntime, or name another library (1.{} or newer) by {}",
                    ort::MINOR_VERSION,
                    crate::library::VARIABLE
                ),
            )
        })?;
        environment.with_name("cif").with_telemetry(false).commit();
        let file = network.model.clone();
        let model = load(&file).map_err(|error| {
            Error::refused(
                format!("{} cannot be loaded: {error}", file.display()),
                "give an ONNX model for the processor, with the files of its data beside it",
            )
        })?;
        let [declared_inputs, declared_outputs] =
            [model.inputs(), model.outputs()].map(|side| side.iter().map(declared).collect::<Vec<_>>());
        let side = |word, declared, named, parts| Side { word, declared, named, parts };
        let inputs = bind(&file, side("input", &declared_inputs, &network.inputs, inputs))?;
        let outputs = bind(&file, side("output", &declared_outputs, &network.outputs, outputs))?;
        Ok(Self { file, model, inputs, outputs })
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
        let failed = |error: ort::Error| {
            Error::refused(
                format!("{file} failed: {error}"),
                "check that it is the model that models.toml says, exported for pictures of any size",
            )
        };
        let mut inputs: Vec<(String, SessionInputValue<'_>)> = Vec::new();
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
            inputs.push((declared.name.clone(), value(declared.element, tensor).map_err(&failed)?));
        }
        if let Some(missing) =
            self.inputs.values().find(|one| !inputs.iter().any(|(name, _)| *name == one.name))
        {
            return Err(Error::refused(
                format!("nothing is given for the input `{}` of {file}", missing.name),
                format!("name its part in {MANIFEST} as an output of the model before it"),
            ));
        }
        let answers = self.model.run(inputs).map_err(&failed)?;
        let mut outputs = BTreeMap::new();
        for (part, declared) in &self.outputs {
            let (shape, values) =
                answers[declared.name.as_str()].try_extract_tensor::<f32>().map_err(&failed)?;
            let shape: Vec<usize> =
                shape.iter().map(|length| usize::try_from(*length).unwrap_or(0)).collect();
            outputs.insert(part.clone(), Tensor::floats(shape, values.to_vec()));
        }
        Ok(outputs)
    }
}

/// Loads a model for as many threads as the command has.
fn load(file: &Path) -> ort::Result<Model> {
    Model::builder()?
        .with_log_level(LogLevel::Error)?
        .with_intra_threads(rayon::current_num_threads())?
        .with_deterministic_compute(true)?
        .commit_from_file(file)
}

/// A tensor as the runtime describes it.
fn declared(outlet: &Outlet) -> Declared {
    let element = match outlet.dtype().tensor_type() {
        Some(TensorElementType::Float32) => Element::Float,
        Some(TensorElementType::Int64) => Element::Int64,
        Some(TensorElementType::Int32) => Element::Int32,
        Some(TensorElementType::Bool) => Element::Bool,
        _ => Element::Other,
    };
    let type_name = outlet
        .dtype()
        .tensor_type()
        .map_or_else(|| outlet.dtype().to_string(), |element| element.to_string());
    let shape = outlet.dtype().tensor_shape().map(|shape| shape.iter());
    let shape = shape.into_iter().flatten().map(|length| usize::try_from(*length).ok()).collect();
    Declared { name: outlet.name().to_owned(), element, type_name, shape }
}

/// A tensor in the type that an input has.
fn value(element: Element, tensor: Tensor) -> ort::Result<SessionInputValue<'static>> {
    let shape = tensor.shape().to_vec();
    Ok(match (element, tensor.values()) {
        (Element::Float | Element::Other, Values::Floats(values)) => {
            Value::from_array((shape, values.clone()))?.into()
        }
        (Element::Float | Element::Other, Values::Integers(values)) => {
            Value::from_array((shape, mapped(values, |value| value as f32)))?.into()
        }
        (Element::Int64, Values::Integers(values)) => Value::from_array((shape, values.clone()))?.into(),
        (Element::Int64, Values::Floats(values)) => {
            Value::from_array((shape, mapped(values, |value| value as i64)))?.into()
        }
        (Element::Int32, Values::Integers(values)) => {
            Value::from_array((shape, mapped(values, |value| value as i32)))?.into()
        }
        (Element::Int32, Values::Floats(values)) => {
            Value::from_array((shape, mapped(values, |value| value as i32)))?.into()
        }
        (Element::Bool, Values::Integers(values)) => {
            Value::from_array((shape, mapped(values, |value| value != 0)))?.into()
        }
        (Element::Bool, Values::Floats(values)) => {
            Value::from_array((shape, mapped(values, |value| value != 0.0)))?.into()
        }
    })
}

fn mapped<A: Copy, B>(values: &[A], into: impl Fn(A) -> B) -> Vec<B> {
    values.iter().copied().map(into).collect()
}
