//! `cif info --gpu`: GPUs, their features and limits, and what of them is used.

use std::collections::BTreeMap;

use cif_render::wgpu::{AdapterFacts, Gpu, GpuError, GpuFeatures, Rasterizer, SubgroupUse};
use serde::Serialize;

use crate::error::Error;
use crate::report::{JsonReport, OnlyReport};

pub(super) fn run(report: &OnlyReport) -> Result<(), Error> {
    let allowed = GpuFeatures::from_environment().map_err(Error::plain)?;
    let adapters = Gpu::adapters();
    // Opened like any command would, kernels included: a GPU that is listed may still refuse.
    let opened = Gpu::open_with(allowed).and_then(|gpu| Rasterizer::new(&gpu).map(|_| gpu));
    let gpu = opened.as_ref().ok();
    let report_of = || GpuReport {
        adapters: adapters.iter().map(|adapter| facts(adapter, allowed)).collect(),
        used: gpu.map(|gpu| gpu.facts().name.as_str()),
        used_subgroups: gpu.map(|gpu| gpu.subgroups().to_string()),
        fault: opened.as_ref().err().map(ToString::to_string),
    };
    report.give(report_of, || print_all(&adapters, &opened, allowed))
}

fn print_all(adapters: &[AdapterFacts], opened: &Result<Gpu, GpuError>, allowed: GpuFeatures) {
    for adapter in adapters {
        print(adapter, allowed);
    }
    match opened {
        Ok(gpu) => {
            let name = &gpu.facts().name;
            if gpu.facts().software {
                println!("--backend wgpu takes {name}; --backend auto takes the processor, as it is faster");
            } else {
                println!("--backend wgpu takes {name}; its kernels compile");
            }
            if *gpu.subgroups() != SubgroupUse::Missing {
                println!("its subgroups are {}", gpu.subgroups());
            }
        }
        Err(error) => println!("--backend wgpu cannot be used: {error}"),
    }
    if !(allowed.subgroups && allowed.timestamps) {
        println!("{} holds optional features back", GpuFeatures::VARIABLE);
    }
}

/// Features of an adapter that kernels use, in words.
fn paths(adapter: &AdapterFacts, allowed: GpuFeatures) -> Vec<String> {
    let mut paths =
        vec!["32-bit floats, workgroup memory, no float atomics (results repeat to the bit)".to_owned()];
    let subgroups = if adapter.software { allowed.software_subgroups } else { allowed.subgroups };
    if adapter.subgroups.is_some() && subgroups {
        paths.push("subgroups for sums over workgroups, after a check of known numbers".to_owned());
    }
    if adapter.software && allowed.software_storage {
        paths.push(
            "constants in storage, as software compiles kernels anew for those in uniform blocks".to_owned(),
        );
    }
    if adapter.packed_half_floats {
        paths.push("16-bit storage of spherical harmonics in draft renders, computed in 32 bits".to_owned());
    }
    if adapter.timestamps && allowed.timestamps {
        paths.push("times of stages from the device".to_owned());
    }
    paths
}

/// GPUs that are offered, and the one that is used.
#[derive(Serialize)]
struct GpuReport<'a> {
    /// Every adapter that Vulkan, Metal and Direct3D 12 offer, GPUs before software.
    adapters: Vec<AdapterReport<'a>>,
    /// Name of the adapter that is used; null where none can be.
    used: Option<&'a str>,
    /// How its subgroups are used, in words.
    used_subgroups: Option<String>,
    /// Reason why no adapter can be used.
    fault: Option<String>,
}

/// An adapter.
#[derive(Serialize)]
struct AdapterReport<'a> {
    /// Name, as the driver has it.
    name: &'a str,
    /// Vulkan, Metal or Direct3D 12.
    interface: &'a str,
    /// Discrete, integrated, virtual, software or other.
    kind: &'static str,
    /// Driver and its version.
    driver: &'a str,
    /// True when the processor does the work of the GPU.
    software: bool,
    /// True when kernels can be timed on the device.
    timestamps: bool,
    /// Least and largest size of its subgroups; null where kernels cannot use them.
    subgroups: Option<(u32, u32)>,
    /// True when kernels can compute in 16-bit floats.
    half_floats: bool,
    /// True when kernels can read numbers that are stored in 16-bit floats.
    packed_half_floats: bool,
    /// Limits that decide how large a scene may be, by name.
    limits: BTreeMap<String, u64>,
    /// Limits below those that the kernels need; empty when they run.
    missing: &'a [String],
    /// Features that kernels use, in words.
    used: Vec<String>,
}

impl JsonReport for GpuReport<'_> {
    const COMMANDS: &'static [&'static str] = &["cif info --gpu"];
}

fn facts(adapter: &AdapterFacts, allowed: GpuFeatures) -> AdapterReport<'_> {
    AdapterReport {
        name: &adapter.name,
        interface: &adapter.interface,
        kind: adapter.kind,
        driver: &adapter.driver,
        software: adapter.software,
        timestamps: adapter.timestamps,
        subgroups: adapter.subgroups,
        half_floats: adapter.half_floats,
        packed_half_floats: adapter.packed_half_floats,
        limits: adapter.limits.iter().map(|(name, value)| (name.replace(' ', "_"), *value)).collect(),
        missing: &adapter.missing,
        used: paths(adapter, allowed),
    }
}

fn print(adapter: &AdapterFacts, allowed: GpuFeatures) {
    println!("{} ({}, {})", adapter.name, adapter.interface, adapter.kind);
    let row = |name: &str, value: String| println!("{name:>28}  {value}");
    row("driver", adapter.driver.clone());
    let has = |there: bool| if there { "yes" } else { "no" }.to_owned();
    row("timestamps", has(adapter.timestamps));
    let subgroups = adapter.subgroups.map_or_else(
        || "no".to_owned(),
        |(least, most)| if least == most { format!("of {least}") } else { format!("of {least} to {most}") },
    );
    row("subgroups", subgroups);
    let (computed, kept) = (has(adapter.half_floats), has(adapter.packed_half_floats));
    row("16-bit floats", format!("{kept} for storage, {computed} for arithmetic (which is not used)"));
    for (name, value) in &adapter.limits {
        row(name, value.to_string());
    }
    for path in paths(adapter, allowed) {
        row("used", path);
    }
    for missing in &adapter.missing {
        row("missing", missing.clone());
    }
    println!();
}
