// Sums in 64-bit fixed point, which come out the same in any order: two 32-bit atomics, the lower one with carry. The
// lower half starts in the middle of its range, so that small sums of either sign carry nothing over. One unit is
// 2^-50, far below what Adam (epsilon 1e-15) distinguishes from zero; sums reach up to 2^13.
//
// The module declares `sums: array<atomic<u32>>`, two per sum, and `faults: array<atomic<u32>>`.

const FIXED_MIDDLE: u32 = 0x80000000u;
// 2^18, and 2^32.
const FIXED_SCALE: f32 = 262144.0;
const FIXED_LOW: f32 = 4294967296.0;
// Bits of 64.0: larger values, infinities and NaN are faults.
const FIXED_LARGEST: u32 = 0x42800000u;

fn add_fixed(index: u32, value: f32) {
    if (bitcast<u32>(value) & 0x7fffffffu) > FIXED_LARGEST {
        atomicOr(&faults[0], PLANES_FAULT);
        return;
    }
    // Of the magnitude, both parts are exact down to the unit.
    let magnitude = abs(value) * FIXED_SCALE;
    let whole = floor(magnitude);
    var high = u32(whole);
    var low = u32((magnitude - whole) * FIXED_LOW);
    if value < 0.0 {
        high = ~high + select(0u, 1u, low == 0u);
        low = ~low + 1u;
    }
    if low != 0u {
        let before = atomicAdd(&sums[2u * index], low);
        high += select(0u, 1u, before > 0xffffffffu - low);
    }
    if high != 0u {
        atomicAdd(&sums[2u * index + 1u], high);
    }
}

// The sum, which becomes zero; for one thread per sum.
fn take_fixed(index: u32) -> f32 {
    let sum = fixed_sum(index);
    clear_fixed(index);
    return sum;
}

fn clear_fixed(index: u32) {
    atomicStore(&sums[2u * index], FIXED_MIDDLE);
    atomicStore(&sums[2u * index + 1u], 0u);
}

fn fixed_sum(index: u32) -> f32 {
    let low = atomicLoad(&sums[2u * index]);
    let high = atomicLoad(&sums[2u * index + 1u]);
    return f32(bitcast<i32>(high)) / FIXED_SCALE
        + f32(bitcast<i32>(low ^ FIXED_MIDDLE)) / (FIXED_SCALE * FIXED_LOW);
}
