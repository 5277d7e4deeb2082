// Shared by both walks of the backward pass: sums of a batch of splats over the workgroup, and pairs without any.

// Nothing reaches these pairs.
fn clear_pairs(first: u32, end: u32) {
    for (var index = first; index < end; index += INVOCATIONS) {
        let entry = entries[index];
        for (var value = 0u; value < SUMS; value += 1u) {
            pair_sums[entry.x * PAIR_SUMS + value] = 0.0;
        }
        clear_row(entry);
    }
}

// Sums of the splats of a batch over the workgroup. Every invocation must come here.
fn sum_batch(lane: Lane, count: u32, batch: u32, longest_row: u32) {
    store_sums(lane, count, batch);
    workgroupBarrier();
    if (longest_row > 0u) {
        sum_responsibilities(lane, count, batch, longest_row);
    }
}
