//! The machine that a command runs on.
//!
//! | module | answers |
//! |---|---|
//! | [`environment`] | which environment variables are read |
//! | [`error`] | what went wrong with which file, and the remedy |
//! | [`memory`] | how much memory is free, and whether work fits in it |
//! | [`python`] | Python as a child process, apart from the current folder |

pub mod environment;
pub mod error;
pub mod memory;
pub mod python;

pub use error::Error;
