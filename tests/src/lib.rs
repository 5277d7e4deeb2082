//! Harness shared by the cross-crate tests in `tests/tests/`.
//!
//! | module | answers |
//! |---|---|
//! | [`capture`] | a small capture with known content, made anew for every test |
//! | [`command`] | the command, run as people run it |
//! | [`models`] | a folder of ONNX models that know the colours of that capture |
//! | [`onnx`] | how such models are written |

pub mod capture;
pub mod command;
pub mod models;
pub mod onnx;
