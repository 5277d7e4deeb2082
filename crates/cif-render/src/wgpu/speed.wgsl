// What a device can do at most: bytes moved by a copy, and multiplications and additions in registers. Rust twin:
// speed.rs.

#import constants
@group(0) @binding(0) var<storage, read> source: array<vec4f>;
@group(0) @binding(1) var<storage, read_write> target_values: array<vec4f>;

@compute @workgroup_size(256)
fn copy_values(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if (at < arrayLength(&source)) {
        target_values[at] = source[at];
    }
}

// Eight chains that do not wait for each other.
@compute @workgroup_size(256)
fn multiply_add(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let at = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    let factor = source[local];
    var a = factor + vec4f(f32(local));
    var b = a + 1.0;
    var c = a + 2.0;
    var d = a + 3.0;
    var e = a + 4.0;
    var f = a + 5.0;
    var g = a + 6.0;
    var h = a + 7.0;
    for (var k = 0u; k < ROUNDS; k += 1u) {
        a = fma(a, factor, factor);
        b = fma(b, factor, factor);
        c = fma(c, factor, factor);
        d = fma(d, factor, factor);
        e = fma(e, factor, factor);
        f = fma(f, factor, factor);
        g = fma(g, factor, factor);
        h = fma(h, factor, factor);
    }
    target_values[at % arrayLength(&target_values)] = ((a + b) + (c + d)) + ((e + f) + (g + h));
}
