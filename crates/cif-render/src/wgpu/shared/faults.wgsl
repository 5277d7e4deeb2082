// Gradients that no optimiser may take, found by their bits: compilers may assume that nothing is infinite.

fn is_beyond(v: f32) -> bool {
    return (bitcast<u32>(v) & 0x7fffffffu) > LARGEST_GRADIENT;
}
