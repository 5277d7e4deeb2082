//! Messages between a process and the one that runs a model or tokenizer for it: a line of JSON, then the values of tensors
//! as they lie in memory.

use std::io::{self, BufRead, Read, Write};
use std::path::PathBuf;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::Reading;
use super::signature::Declared;
use crate::Tensor;
use crate::tensor::Values;

/// A question of a process to the one that runs a model for it.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Question {
    /// Load the library.
    Library(PathBuf),
    /// Open a model.
    Model { file: PathBuf, threads: usize },
    /// Run it on the tensors that follow, for the outputs of these names.
    Run { names: Vec<String>, wanted: Vec<String> },
    /// Open a tokenizer, the text of its file.
    Tokenizer(String),
    /// Read a text.
    Read(String),
}

/// The answer to a question.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Answer {
    Ready,
    Declared([Vec<Declared>; 2]),
    /// The tensors that follow.
    Outputs,
    Reading(Reading),
    Failed(String),
}

/// A tensor that follows a message.
#[derive(Serialize, Deserialize)]
struct Head {
    shape: Vec<usize>,
    integers: bool,
}

/// The line of a message.
#[derive(Serialize, Deserialize)]
struct Line<T> {
    message: T,
    tensors: Vec<Head>,
}

/// Writes a message and its tensors.
pub(super) fn send<T: Serialize>(to: &mut impl Write, message: T, tensors: &[Tensor]) -> io::Result<()> {
    let head = |tensor: &Tensor| Head {
        shape: tensor.shape().to_vec(),
        integers: matches!(tensor.values(), Values::Integers(_)),
    };
    let mut bytes = serde_json::to_vec(&Line { message, tensors: tensors.iter().map(head).collect() })?;
    bytes.push(b'\n');
    to.write_all(&bytes)?;
    for tensor in tensors {
        to.write_all(match tensor.values() {
            Values::Floats(values) => bytemuck::cast_slice(values),
            Values::Integers(values) => bytemuck::cast_slice(values),
        })?;
    }
    to.flush()
}

/// The next message; `None` at the end.
pub(super) fn receive<T: DeserializeOwned>(from: &mut impl BufRead) -> io::Result<Option<(T, Vec<Tensor>)>> {
    let mut line = Vec::new();
    if from.read_until(b'\n', &mut line)? == 0 {
        return Ok(None);
    }
    let Line { message, tensors } = serde_json::from_slice(&line)?;
    let tensors = tensors.into_iter().map(|head| tensor(from, head)).collect::<io::Result<_>>()?;
    Ok(Some((message, tensors)))
}

fn tensor(from: &mut impl Read, Head { shape, integers }: Head) -> io::Result<Tensor> {
    let length = shape.iter().try_fold(1, |product: usize, length| product.checked_mul(*length));
    let length = length.ok_or_else(|| io::Error::other("a tensor is too large"))?;
    Ok(if integers {
        let mut values = vec![0_i64; length];
        from.read_exact(bytemuck::cast_slice_mut(&mut values))?;
        Tensor::integers(shape, values)
    } else {
        let mut values = vec![0.0_f32; length];
        from.read_exact(bytemuck::cast_slice_mut(&mut values))?;
        Tensor::floats(shape, values)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_with_their_tensors() {
        let tensors = [
            Tensor::floats([2, 1], vec![1.5, f32::NEG_INFINITY]),
            Tensor::integers(Vec::new(), vec![i64::MIN]),
            Tensor::floats([0, 7], vec![]),
        ];
        let mut bytes = Vec::new();
        send(&mut bytes, Answer::Outputs, &tensors).unwrap();
        send(&mut bytes, Answer::Ready, &[]).unwrap();
        let mut from = &*bytes;
        let (answer, read) = receive::<Answer>(&mut from).unwrap().unwrap();
        assert!(matches!(answer, Answer::Outputs));
        assert_eq!(read, tensors);
        assert!(matches!(receive::<Answer>(&mut from).unwrap(), Some((Answer::Ready, _))));
        assert!(receive::<Answer>(&mut from).unwrap().is_none());
        assert!(receive::<Answer>(&mut &bytes[..bytes.len() / 2]).is_err());
    }
}
