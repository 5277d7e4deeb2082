//! Output files: written whole or not at all, never in place of anything else, and cleaned up after.
//!
//! | module | answers |
//! |---|---|
//! | `name` | which names of frames may become paths, and the path of such a name in a folder |
//! | `place` | where an output goes once links are followed |
//! | `shared` | files and folders of our names in places that others may write into |
//! | `unfinished` | temporary files next to their outputs, which never outlive their process for long |
//! | `workplace` | folders for temporary files, which do not either |
//!
//! Outputs are written to a temporary file in their own folder, which takes their name once it is on the disk.
//! Temporary files begin with `.cif-tmp-`, have a random name that ends in the machine's, and are locked by the process that
//! writes them. They are removed when writing fails and by [`abandon`]; those of a process that was killed are not locked any
//! more, and go when the next output is written into their folder, from another machine a day later.

mod name;
mod place;
mod shared;
mod unfinished;
mod workplace;

pub use name::{check_name, check_taxonomy, inside};
pub use place::{Place, folder_of, place, target};
pub use shared::{check_of_owner, check_private, open_own, private_folder};
pub use unfinished::{NewFile, Removed, Scratch, abandon, finish_all, probe, write};
pub use workplace::Workplace;
