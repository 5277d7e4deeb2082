//! Harness shared by the cross-crate tests in `tests/tests/`.
//!
//! | module | answers |
//! |---|---|
//! | [`capture`] | a small capture with known content, made anew for every test |
//! | [`command`] | the command, run as people run it |

pub mod capture;
pub mod command;
