// The optimiser's step of everything that Gaussians have: geometry (with the limits of occupancy, and unit quaternions
// now and then) and spherical harmonics. Gradients become zero. Rust twins: adam/mod.rs, trainer/optimiser.rs,
// trainer/step.rs `keep_in_range`. Source: methods reference 1.1.

#import constants
#import gaussian_rates

@group(0) @binding(0) var<uniform> rates: GaussianRates;
@group(0) @binding(1) var<storage, read_write> parameters: array<f32>;
@group(0) @binding(2) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(3) var<storage, read_write> first_moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> second_moments: array<f32>;
// Screen gradient, radius and whether visible.
@group(0) @binding(5) var<storage, read> screen: array<vec4f>;
// The second is not 0 while steps wait for the host.
@group(0) @binding(6) var<storage, read_write> faults: array<atomic<u32>>;

#import adam

// Whether a Gaussian takes part at all.
fn takes_part(row: u32) -> bool {
    return atomicLoad(&faults[1]) == 0u && (rates.visible_only == 0u || screen[row].w > 0.0);
}

// Moves a float.
fn step(at: u32, rate: f32, second_bias: f32) {
    let g = gradients[at];
    gradients[at] = 0.0;
    if rate <= 0.0 {
        return;
    }
    let moved = move_by(parameters[at], g, first_moments[at], second_moments[at], rate, second_bias);
    parameters[at] = moved.parameter;
    first_moments[at] = moved.first;
    second_moments[at] = moved.second;
}

// A thread per Gaussian.
@compute @workgroup_size(64)
fn adam_geometry(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let row = (group.y * MAX_WORKGROUPS + group.x) * 64u + local;
    if row >= rates.gaussians {
        return;
    }
    let base = row * GEOMETRY_FLOATS;
    let taking_part = takes_part(row);
    for (var k = 0u; k < GEOMETRY_FLOATS; k++) {
        let rate = select(0.0, rates.geometry[k / 4u][k % 4u], taking_part);
        step(base + k, rate, rates.geometry_second[k / 4u][k % 4u]);
    }
    if atomicLoad(&faults[1]) != 0u {
        return;
    }
    let occupancy = base + OCCUPANCY_COLUMN;
    parameters[occupancy] = clamp(parameters[occupancy], rates.lowest_occupancy, rates.highest_occupancy);
    if rates.renormalise != 0u {
        let first = base + QUATERNION_COLUMN;
        let q = vec4f(parameters[first], parameters[first + 1u], parameters[first + 2u], parameters[first + 3u]);
        let norm = sqrt(dot(q, q));
        if norm >= MIN_NORM && is_finite(norm) {
            for (var k = 0u; k < 4u; k++) {
                parameters[first + k] = q[k] / norm;
            }
        }
    }
}

// A thread per coefficient.
@compute @workgroup_size(256)
fn adam_sh(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if at >= rates.gaussians * SH_FLOATS {
        return;
    }
    let k = at % SH_FLOATS;
    let rate = select(rates.sh_rest, rates.sh_base, k < 3u);
    let moves = k < rates.sh_active && takes_part(at / SH_FLOATS);
    step(at, select(0.0, rate, moves), rates.sh_second);
}
