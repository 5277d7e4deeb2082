//! The `cif` command.

fn main() {
    std::process::exit(cif::run(std::env::args_os().collect()));
}
