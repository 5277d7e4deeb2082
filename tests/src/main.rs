//! The `cif` command, for the tests of this package.

fn main() {
    cif::own_process();
    std::process::exit(cif::run(std::env::args_os().collect()));
}
