// Gradients that no optimiser may take, found by their bits: compilers may assume that nothing is infinite.

fn is_beyond(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7fffffffu) > LARGEST_GRADIENT;
}

// Bit of a float of a Gaussian's geometry.
fn geometry_fault(component: u32) -> u32 {
    if component < 3u {
        return MEANS_FAULT;
    }
    if component == 3u {
        return OPACITY_FAULT;
    }
    if component < 7u {
        return LOG_SCALES_FAULT;
    }
    return select(QUATERNIONS_FAULT, OCCUPANCY_FAULT, component == 7u);
}
