//! Questions in words: masks of a prompt, and embeddings of pictures and texts, by ONNX models of the user's own.
//!
//! | module | answers |
//! |---|---|
//! | [`models`] | which files there are, and what their tensors are called |
//! | [`library`] | where the library of ONNX Runtime is |
//! | [`runtime`] | running a model with named, checked tensors, and its tokenizer, behind the feature `onnx` |
//! | [`tensor`] | arrays that go in and come out |
//! | [`picture`] | pictures as models take them |
//! | [`grounding`] | boxes of a prompt (Grounding DINO) |
//! | [`segment`] | masks of boxes (SAM) |
//! | [`prompt`] | both together: the mask of a prompt |
//! | [`embedding`] | pictures and texts in one space (CLIP) |
//! | [`cache`] | masks that were made before |
//!
//! Nothing is downloaded: models, tokenizers and the library of ONNX Runtime are files of the user's. Without the feature
//! `onnx` all of this is there but for running models, which is refused with advice on how to get it.

pub mod cache;
pub mod embedding;
pub mod grounding;
pub mod library;
pub mod models;
pub mod picture;
pub mod prompt;
pub mod runtime;
pub mod segment;
pub mod tensor;

pub use cache::Cache;

pub use cif_system::Error;
pub use models::Models;
pub use picture::Picture;
pub use prompt::Prompter;
pub use tensor::Tensor;
