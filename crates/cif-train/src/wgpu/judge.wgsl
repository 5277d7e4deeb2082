// Judges a step before anything moves: losses and gradients that no optimiser may take, or a view whose pairs had no
// room, make it and every step after it move nothing until the host has answered. One invocation. Rust twin:
// trainer/guard.rs.

#import constants
#import faults
#import judgement

@group(0) @binding(0) var<uniform> judgement: Judgement;
// Two per view, see losses.wgsl.
@group(0) @binding(1) var<storage, read> results: array<vec4f>;
// Counts of the view.
@group(0) @binding(2) var<storage, read> counts: array<u32>;
// Bits of the step, and whether steps wait for the host.
@group(0) @binding(3) var<storage, read_write> faults: array<u32>;

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

@compute @workgroup_size(1)
fn judge() {
    let sums = results[2u * judgement.slot];
    let similarity = results[2u * judgement.slot + 1u];
    var found = faults[0] | judgement.known;
    if !is_finite(sums.x) || !is_finite(similarity.x) {
        found |= COLOR_LOSS_FAULT;
    }
    if !is_finite(sums.z) {
        found |= INSTANCE_LOSS_FAULT;
    }
    if counts[PAIRS_WORD] != counts[WANTED_PAIRS_WORD] {
        found |= NO_ROOM_FAULT;
    }
    faults[0] = found;
    // Gradients of what keeps still are nobody's business.
    if judgement.is_last != 0u && (found & judgement.counts) != 0u {
        faults[1] = 1u;
    }
}
