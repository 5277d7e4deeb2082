//! Channels of animations that point to properties (`KHR_animation_pointer`), which the glTF library does not know.

use serde_json::{Value, json};

use crate::{POINTER, VISIBILITY};

/// A channel that shows and hides a node.
pub(crate) struct Pointed {
    /// Place among the channels, for messages.
    pub(crate) channel: usize,
    pub(crate) sampler: usize,
    pub(crate) node: usize,
}

/// Takes channels without a node out of all animations, as glTF demands of whoever does not know them: those of the
/// first that show and hide nodes are returned, and those that move nodes become ordinary ones.
pub(crate) fn take(value: &mut Value) -> Vec<Pointed> {
    let mut pointed = Vec::new();
    let animations = value.get_mut("animations").and_then(Value::as_array_mut).into_iter().flatten();
    for (animation, found) in animations.enumerate() {
        let Some(channels) = found.get_mut("channels").and_then(Value::as_array_mut) else { continue };
        let mut kept = Vec::with_capacity(channels.len());
        for (number, mut channel) in std::mem::take(channels).into_iter().enumerate() {
            let target = channel.get("target");
            if target.is_none_or(|target| target.get("node").is_some()) {
                kept.push(channel);
                continue;
            }
            let pointer = channel.pointer(&format!("/target/extensions/{POINTER}/pointer"));
            let Some((node, property)) = pointer.and_then(Value::as_str).and_then(of_node) else { continue };
            match property.as_str() {
                "translation" | "rotation" | "scale" => {
                    channel["target"] = json!({ "node": node, "path": property });
                    kept.push(channel);
                }
                property if animation == 0 && property == format!("extensions/{VISIBILITY}/visible") => {
                    let sampler = channel.get("sampler").and_then(Value::as_u64).unwrap_or(u64::MAX);
                    pointed.push(Pointed { channel: number, sampler: sampler as usize, node });
                }
                _ => {}
            }
        }
        *channels = kept;
    }
    pointed
}

/// Node and property that a pointer names.
fn of_node(pointer: &str) -> Option<(usize, String)> {
    let (node, property) = pointer.strip_prefix("/nodes/")?.split_once('/')?;
    Some((node.parse().ok()?, property.to_owned()))
}
