// Rows of identities: (dense instance index, bits of its probability), ascending indices.

// Probability of an instance in a row; 0 outside its support.
fn probability_of(first: u32, end: u32, instance: u32) -> f32 {
    for (var entry = first; entry < end; entry += 1u) {
        let item = identities[entry];
        if (item.x >= instance) {
            return select(0.0, bitcast<f32>(item.y), item.x == instance);
        }
    }
    return 0.0;
}
