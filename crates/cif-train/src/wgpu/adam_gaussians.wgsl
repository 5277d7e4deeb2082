// The optimiser's step of everything that Gaussians have: geometry (with the limits of occupancy, and unit quaternions
// now and then) and spherical harmonics. Gradients become zero. Rust twins: adam/mod.rs, trainer/optimiser.rs,
// trainer/step.rs `keep_in_range`. Source: methods reference 1.1.

#import constants
#import gaussian_rates

@group(0) @binding(0) var<uniform> rates: GaussianRates;
// Rows of GEOMETRY_FLOATS or SH_FLOATS floats, by fours; so are gradients and moments.
@group(0) @binding(1) var<storage, read_write> parameters: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> gradients: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> first_moments: array<vec4f>;
@group(0) @binding(4) var<storage, read_write> second_moments: array<vec4f>;
// Screen gradient, radius and whether visible.
@group(0) @binding(5) var<storage, read> screen: array<vec4f>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(6) var<storage, read_write> faults: array<atomic<u32>>;

#import adam

const GEOMETRY_QUADS: u32 = GEOMETRY_FLOATS / 4u;
const SH_QUADS: u32 = SH_FLOATS / 4u;

// Whether a Gaussian takes part at all.
fn takes_part(row: u32) -> bool {
    return atomicLoad(&faults[1]) == 0u && (rates.visible_only == 0u || screen[row].w > 0.0);
}

// Moves four floats, of which those without a rate stay.
fn step(at: u32, rate: vec4f, second_bias: vec4f) {
    let g = gradients[at];
    gradients[at] = vec4f(0.0);
    if !any(rate > vec4f(0.0)) {
        return;
    }
    var parameter = parameters[at];
    var first = first_moments[at];
    var second = second_moments[at];
    for (var k = 0u; k < 4u; k++) {
        if rate[k] > 0.0 {
            let moved = move_by(parameter[k], g[k], first[k], second[k], rate[k], second_bias[k]);
            parameter[k] = moved.parameter;
            first[k] = moved.first;
            second[k] = moved.second;
        }
    }
    parameters[at] = parameter;
    first_moments[at] = first;
    second_moments[at] = second;
}

// A thread per Gaussian.
@compute @workgroup_size(64)
fn adam_geometry(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    if row >= rates.gaussians {
        return;
    }
    let base = row * GEOMETRY_QUADS;
    let taking_part = takes_part(row);
    for (var k = 0u; k < GEOMETRY_QUADS; k++) {
        step(base + k, select(vec4f(0.0), rates.geometry[k], taking_part), rates.geometry_second[k]);
    }
    if atomicLoad(&faults[1]) != 0u {
        return;
    }
    let occupancy = base + OCCUPANCY_COLUMN / 4u;
    let logit = parameters[occupancy][OCCUPANCY_COLUMN % 4u];
    parameters[occupancy][OCCUPANCY_COLUMN % 4u] =
        clamp(logit, rates.lowest_occupancy, rates.highest_occupancy);
    if rates.renormalise != 0u {
        // A vector of its own.
        let q = parameters[base + QUATERNION_COLUMN / 4u];
        let norm = sqrt(dot(q, q));
        if norm >= MIN_NORM && is_finite(norm) {
            parameters[base + QUATERNION_COLUMN / 4u] = q / norm;
        }
    }
}

// A thread per four coefficients; those in use come first, and the first three have a rate of their own.
@compute @workgroup_size(256)
fn adam_sh(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if at >= rates.gaussians * SH_QUADS {
        return;
    }
    let k = vec4u(at % SH_QUADS * 4u) + vec4u(0u, 1u, 2u, 3u);
    let rate = select(vec4f(rates.sh_rest), vec4f(rates.sh_base), k < vec4u(3u));
    let moves = takes_part(at / SH_QUADS);
    step(at, select(vec4f(0.0), rate, (k < vec4u(rates.sh_active)) & vec4<bool>(moves)), vec4f(rates.sh_second));
}
