//! The machine that a command runs on.
//!
//! | module | answers |
//! |---|---|
//! | [`environment`] | which environment variables are read |
//! | [`error`] | what went wrong with which file, and the remedy |
//! | [`host`] | the name of this machine |
//! | [`memory`] | how much memory is free, and whether work fits in it |
//! | [`python`] | Python as a child process, apart from the current folder |

pub mod environment;
pub mod error;
pub mod host;
pub mod memory;
pub mod python;

pub use error::Error;
