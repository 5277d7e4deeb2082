//! The machine that a command runs on.
//!
//! | module | answers |
//! |---|---|
//! | [`memory`] | how much memory is free, and whether work fits in it |
//! | [`python`] | Python as a child process, apart from the current folder |

pub mod memory;
pub mod python;
