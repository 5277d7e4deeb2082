// Takes the gradient from pixels of labels that are left out, and from those that are judged by. Rust twin:
// trainer/guidance.rs `leave_out_travelling`, trainer/earned.rs `leave_out_held_out`.

#import constants
#import loss_settings

@group(0) @binding(0) var<uniform> settings: LossSettings;
// Dense instance index + 1, or 0.
@group(0) @binding(1) var<storage, read> labels: array<u32>;
// Per label, whether its pixels train nothing.
@group(0) @binding(2) var<storage, read> left_out: array<u32>;
@group(0) @binding(3) var<storage, read_write> v_colors: array<vec4f>;

@compute @workgroup_size(256)
fn leave_out(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) local: u32) {
    let pixel = (group.y * MAX_WORKGROUPS + group.x) * 256u + local;
    if pixel >= settings.pixels {
        return;
    }
    var leaves_out = false;
    if (settings.leaves_out & 1u) != 0u {
        leaves_out = left_out[labels[pixel]] != 0u;
    }
    if (settings.leaves_out & 2u) != 0u {
        let column = pixel % settings.width;
        let row = pixel / settings.width;
        leaves_out = leaves_out
            || (column % JUDGED_SPACING == JUDGED_COLUMN && row % JUDGED_SPACING == JUDGED_ROW);
    }
    if leaves_out {
        v_colors[pixel] = vec4f(0.0);
    }
}
