//! The `cif` command.

fn main() {
    cif::end_with_reader();
    std::process::exit(cif::run(std::env::args_os().collect()));
}
