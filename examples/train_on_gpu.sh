#!/bin/sh
# Trains the example capture on a GPU, goes on with it on the processor, and compares what both need for a step.
# Usage: examples/train_on_gpu.sh [OUT] [further options of `cif train`]; CIF names the command, else the one on PATH.
# Without a GPU, Mesa's lavapipe runs the same kernels on the processor: tens of times slower, to the same quality.
set -eu
capture=$(cd "$(dirname "$0")" && pwd)/tabletop-mini
out=${1:-out/gpu}
[ $# -eq 0 ] || shift
cif=${CIF:-cif}
mkdir -p "$out"

# What there is: adapter, driver, features and limits, and whether the kernels compile.
"$cif" info --gpu

# A run that stops half way, with everything that the next step needs.
"$cif" train "$capture" -o "$out/scene.cif" --preset draft --backend wgpu --stop-after 600 --force "$@"

# It goes on on the other backend, or on the same one: `--backend wgpu`.
"$cif" train "$capture" -o "$out/scene.cif" --backend cpu --resume

"$cif" eval "$out/scene.cif" "$capture"
"$cif" render "$out/scene.cif" --capture "$capture" --split val --backend auto -o "$out/novel" --force

# Where the time of a step goes: on the device, stage by stage beside the least that each needs, where it has timestamps;
# and on the processor.
"$cif" bench step "$capture" --scene "$out/scene.cif" --backend wgpu --warm-up 3 --steps 10
