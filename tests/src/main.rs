//! The `cif` command, for the tests of this package.

fn main() {
    cif::end_with_reader();
    std::process::exit(cif::run(std::env::args_os().collect()));
}
