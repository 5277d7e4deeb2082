//! `cif info --gpu`: GPUs, their features and limits, and what of them is used.

use cif_render::wgpu::{AdapterFacts, Gpu, Rasterizer};
use serde_json::{Value, json};

use crate::error::Error;

pub(super) fn run(as_json: bool) -> Result<(), Error> {
    let adapters = Gpu::adapters();
    // Opened like any command would, kernels included: a GPU that is listed may still refuse.
    let opened = Gpu::open().and_then(|gpu| Rasterizer::new(&gpu).map(|_| gpu.facts().clone()));
    if as_json {
        let adapters: Vec<Value> = adapters.iter().map(facts).collect();
        let (used, fault) = match &opened {
            Ok(used) => (json!(used.name), Value::Null),
            Err(error) => (Value::Null, json!(error.to_string())),
        };
        println!("{:#}", json!({ "adapters": adapters, "used": used, "fault": fault }));
        return Ok(());
    }
    for adapter in &adapters {
        print(adapter);
    }
    match opened {
        Ok(used) if used.software => {
            println!(
                "--backend wgpu takes {}; --backend auto takes the processor, as it is faster",
                used.name
            );
        }
        Ok(used) => println!("--backend wgpu takes {}; its kernels compile", used.name),
        Err(error) => println!("--backend wgpu cannot be used: {error}"),
    }
    Ok(())
}

/// What is used of an adapter, in words.
fn paths(adapter: &AdapterFacts) -> Vec<String> {
    let mut paths =
        vec!["32-bit floats, workgroup memory, no float atomics (results repeat to the bit)".to_owned()];
    if adapter.timestamps {
        paths.push("times of stages from the device".to_owned());
    }
    paths
}

fn facts(adapter: &AdapterFacts) -> Value {
    let limits: serde_json::Map<String, Value> =
        adapter.limits.iter().map(|(name, value)| (name.replace(' ', "_"), json!(value))).collect();
    json!({
        "name": adapter.name,
        "interface": adapter.interface,
        "kind": adapter.kind,
        "driver": adapter.driver,
        "software": adapter.software,
        "timestamps": adapter.timestamps,
        "subgroups": adapter.subgroups,
        "half_floats": adapter.half_floats,
        "limits": limits,
        "missing": adapter.missing,
        "used": paths(adapter),
    })
}

fn print(adapter: &AdapterFacts) {
    println!("{} ({}, {})", adapter.name, adapter.interface, adapter.kind);
    let row = |name: &str, value: String| println!("{name:>28}  {value}");
    row("driver", adapter.driver.clone());
    let has = |there: bool| if there { "yes" } else { "no" }.to_owned();
    row("timestamps", has(adapter.timestamps));
    let subgroups = adapter.subgroups.map_or_else(
        || "no".to_owned(),
        |(least, most)| if least == most { format!("of {least}") } else { format!("of {least} to {most}") },
    );
    row("subgroups", format!("{subgroups} (not used)"));
    row("16-bit floats", format!("{} (not used)", has(adapter.half_floats)));
    for (name, value) in &adapter.limits {
        row(name, value.to_string());
    }
    for path in paths(adapter) {
        row("used", path);
    }
    for missing in &adapter.missing {
        row("missing", missing.clone());
    }
    println!();
}
