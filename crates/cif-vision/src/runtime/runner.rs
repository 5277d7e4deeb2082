//! A model in this process, by the names of its own tensors. The library of ONNX Runtime is loaded once per process.

use std::path::Path;

use ort::logging::LogLevel;
use ort::session::{Session, SessionInputValue};
use ort::value::{Outlet, Tensor as Value, TensorElementType};

use super::signature::{Declared, Element};
use crate::Tensor;
use crate::tensor::Values;

/// Loads the library.
///
/// # Errors
/// When it is another version, in words. Of a file that is no such library, the call may never come back.
pub(super) fn load_library(library: &Path) -> Result<(), String> {
    let environment = ort::init_from(library).map_err(|error| error.to_string())?;
    environment.with_name("cif").with_telemetry(false).commit();
    Ok(())
}

/// An opened model.
#[derive(Debug)]
pub(super) struct Runner {
    model: Session,
}

impl Runner {
    /// Opens a model for as many threads.
    ///
    /// # Errors
    /// When it cannot be loaded, in the words of the runtime.
    pub(super) fn open(file: &Path, threads: usize) -> Result<Self, String> {
        let open = || -> ort::Result<Session> {
            Session::builder()?
                .with_log_level(LogLevel::Error)?
                .with_intra_threads(threads)?
                .with_deterministic_compute(true)?
                .commit_from_file(file)
        };
        Ok(Self { model: open().map_err(|error| error.to_string())? })
    }

    /// Inputs and outputs.
    pub(super) fn declared(&self) -> [Vec<Declared>; 2] {
        [self.model.inputs(), self.model.outputs()].map(|side| side.iter().map(declared).collect())
    }

    /// The requested outputs for some inputs.
    ///
    /// # Errors
    /// When the model fails, in the words of the runtime.
    pub(super) fn run(
        &mut self,
        given: Vec<(String, Tensor)>,
        requested: &[String],
    ) -> Result<Vec<Tensor>, String> {
        let [declared, _] = self.declared();
        let run = || -> ort::Result<Vec<Tensor>> {
            let mut inputs: Vec<(String, SessionInputValue<'_>)> = Vec::with_capacity(given.len());
            for (name, tensor) in given {
                let element = declared.iter().find(|one| one.name == name);
                let element = element.map_or(Element::Other, |one| one.element);
                inputs.push((name, value(element, tensor)?));
            }
            let answers = self.model.run(inputs)?;
            let mut outputs = Vec::with_capacity(requested.len());
            for name in requested {
                let (shape, values) = answers[name.as_str()].try_extract_tensor::<f32>()?;
                let shape: Vec<usize> =
                    shape.iter().map(|length| usize::try_from(*length).unwrap_or(0)).collect();
                outputs.push(Tensor::floats(shape, values.to_vec()));
            }
            Ok(outputs)
        };
        run().map_err(|error| error.to_string())
    }
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
