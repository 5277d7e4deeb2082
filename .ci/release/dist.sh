#!/usr/bin/env bash
# Everything that is published of the last commit, into a folder. `make dist` starts it with its tools on the PATH.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
out=$1 source=$2
mkdir -p "$(dirname "$out")" "$(dirname "$source")"
out=$(realpath -m "$out") source=$(realpath -m "$source")
libraries=$(rustc --print sysroot)/lib/rustlib

# Wheels for machines whose Rust library is installed: all that ARCHS names, or else those that can be made here.
archs=()
for arch in ${ARCHS:-x86_64 aarch64}; do
    if [ -d "$libraries/$arch-unknown-linux-gnu/lib" ]; then
        archs+=("$arch")
    elif [ -n "${ARCHS:-}" ]; then
        echo "$arch: Rust's library is not installed: rustup target add $arch-unknown-linux-gnu" >&2
        exit 1
    else
        echo "$arch: skipped, because Rust's library is not installed: rustup target add $arch-unknown-linux-gnu"
    fi
done
# How the licences of Rust's own library reach the wheels.
notices=$(dirname "$(dirname "$libraries")")/share/doc/rust/COPYRIGHT-library.html
if [ ! -f "$notices" ]; then
    echo "$notices: missing; it holds the licences of Rust's library: rustup component add rustc" >&2
    exit 1
fi

# A clone, so that what is built is what is committed, and knows its commit. It is kept: files that stay the same are not
# compiled again.
commit=$(git -C "$root" rev-parse HEAD)
if [ -n "$(git -C "$root" status --porcelain)" ]; then
    echo "changes that are not committed are left out"
fi
[ -d "$source/.git" ] || git clone --quiet --shared --no-checkout "$root" "$source"
cd "$source"
git checkout --quiet --force --detach "$commit"
git clean -ffdqx
rm -rf "$out"
mkdir -p "$out"
version=$(sed -n '/^\[workspace\.package\]/,/^version/s/^version = "\(.*\)"/\1/p' Cargo.toml)
# Entries of the archives, the SBOM and the wheels have the time of the commit.
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct)
export SOURCE_DATE_EPOCH
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target}

git archive --format=tar --prefix="cif-$version/" HEAD | gzip -9n >"$out/cif-$version-source.tar.gz"
python plugin/blender/build.py "$out"

# Licences come first: a crate without one of those in about.toml ends it here, before anything is built. Maturin puts
# files into the wheel whose names begin with LICENSE.
zig=$(python -c 'import pathlib, ziglang; print(pathlib.Path(ziglang.__file__).parent)')
crates=(--manifest-path crates/cif-python/Cargo.toml --features extension-module)
cargo about generate "${crates[@]}" --locked --fail -c .ci/release/about.toml -o LICENSE-crates.txt .ci/release/about.hbs
cargo metadata --format-version 1 --locked --filter-platform x86_64-unknown-linux-gnu \
    | python .ci/release/notices.py >>LICENSE-crates.txt
cp "$notices" LICENSE-rust.html
{
    echo "Zig's own functions, and the library that it links in to unwind the stack"
    for file in LICENSE lib/libunwind/LICENSE.TXT; do printf '\n--- %s\n\n' "$file"; cat "$zig/$file"; done
} >LICENSE-zig.txt
cp LICENSE LICENSE-* "$out"

# Paths of this machine would be in messages of panics.
export RUSTFLAGS="--remap-path-prefix=$source=/cif --remap-path-prefix=${CARGO_HOME:-$HOME/.cargo}=/cargo"
for arch in "${archs[@]}"; do
    target=$arch-unknown-linux-gnu
    cargo cyclonedx "${crates[@]}" --target "$target" --format json --spec-version 1.5 --override-filename raw
    sbom=$out/cif4d-$version-$arch.cdx.json
    python .ci/release/sbom.py crates/cif-python/raw.json "$sbom" "$(rustc --version)" "$(python -m ziglang version)"
    maturin build --release --zig --target "$target" --compatibility manylinux_2_28 --sbom-include "$sbom" --out "$out"
done

cd "$out"
sha256sum -- * >"$source/SHA256SUMS"
mv "$source/SHA256SUMS" .
ls -l
