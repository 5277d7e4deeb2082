// Hexplane lookup at the time of a view. Source: methods reference 2.2 and 11 (idea 4). Shared by the stages of
// the deformation; twins: cpu/deform.rs, reference/deform.rs.
//
// All Gaussians of a view share its time, so the time planes are lines here, `[columns, CHANNELS]`, interpolated by
// deform_prepare. Spatial planes are `[rows, columns, CHANNELS]`.

struct AxisTap {
    node: u32,
    fraction: f32,
    // d coordinate / d position; 0 where clamped.
    slope: f32,
}

fn axis_tap(level: u32, axis: u32, position: f32) -> AxisTap {
    let last = deformation.last[level][axis];
    let slope = deformation.slope[level][axis];
    let unclamped = ((position - deformation.low[axis]) - deformation.low_rest[axis]) * slope;
    // A border that single precision just misses is still the border, where no gradient reaches the position.
    let inside = unclamped > 0.0 && unclamped < last * (1.0 - 2.4e-7);
    let coordinate = clamp(unclamped, 0.0, last);
    let node = min(u32(coordinate), u32(last) - 1u);
    return AxisTap(node, coordinate - f32(node), select(0.0, slope, inside));
}

// First floats of a bilinear tap: node (row, column), and the distance to the next row.
fn first_node(start: u32, columns: u32, column: AxisTap, row: AxisTap) -> u32 {
    return start + (row.node * columns + column.node) * CHANNELS;
}

fn bilinear(first: u32, columns: u32, column: AxisTap, row: AxisTap) -> f32 {
    let f = column.fraction;
    let g = row.fraction;
    let next = first + columns * CHANNELS;
    return (1.0 - f) * (1.0 - g) * planes[first] + f * (1.0 - g) * planes[first + CHANNELS]
        + (1.0 - f) * g * planes[next] + f * g * planes[next + CHANNELS];
}

fn linear(first: u32, tap: AxisTap) -> f32 {
    return (1.0 - tap.fraction) * lines[first] + tap.fraction * lines[first + CHANNELS];
}

// Where feature `level * CHANNELS + channel` is read at a canonical position: a bilinear tap in each spatial plane, a
// linear one in each line.
struct FeatureTaps {
    x: AxisTap,
    y: AxisTap,
    z: AxisTap,
    columns_x: u32,
    columns_y: u32,
    // First floats of the taps of xy, xz, yz, and of the lines of x, y, z.
    planes: vec3<u32>,
    lines: vec3<u32>,
}

fn feature_taps(position: vec3<f32>, feature: u32) -> FeatureTaps {
    let level = feature / CHANNELS;
    let channel = feature % CHANNELS;
    let x = axis_tap(level, 0u, position.x);
    let y = axis_tap(level, 1u, position.y);
    let z = axis_tap(level, 2u, position.z);
    let columns_x = u32(deformation.last[level].x) + 1u;
    let columns_y = u32(deformation.last[level].y) + 1u;
    let starts = deformation.planes[level];
    let line_starts = deformation.lines[level];
    let planes = vec3<u32>(
        first_node(starts.x, columns_x, x, y) + channel,
        first_node(starts.y, columns_x, x, z) + channel,
        first_node(starts.z, columns_y, y, z) + channel,
    );
    let nodes = vec3<u32>(x.node, y.node, z.node);
    let lines = line_starts.xyz + nodes * CHANNELS + channel;
    return FeatureTaps(x, y, z, columns_x, columns_y, planes, lines);
}

// Values of xy, xz, yz and of the lines of x, y, z; the feature is their product.
fn plane_values(taps: FeatureTaps) -> array<f32, 6> {
    return array<f32, 6>(
        bilinear(taps.planes.x, taps.columns_x, taps.x, taps.y),
        bilinear(taps.planes.y, taps.columns_x, taps.x, taps.z),
        bilinear(taps.planes.z, taps.columns_y, taps.y, taps.z),
        linear(taps.lines.x, taps.x),
        linear(taps.lines.y, taps.y),
        linear(taps.lines.z, taps.z),
    );
}

fn look_up(position: vec3<f32>, feature: u32) -> f32 {
    let values = plane_values(feature_taps(position, feature));
    return values[0] * values[1] * values[2] * values[3] * values[4] * values[5];
}
