//! Cost of writing a stage: `write_speed SPLATS SAMPLES OUT.usdc` makes one object of so many splats with
//! spherical harmonics of degree 3 (deforming where SAMPLES is above 1), writes it and prints bytes, wall and CPU
//! seconds of the writing, and the peak memory of the process. Run it with the feature `python`, as `make test-usd`
//! does.

use cif_geometry::{Bounds, RigidTransform};
use cif_scene::{
    DenseMotion, DenseSample, Motion, MotionModel, MotionReport, Node, NodeKind, Origin, SceneGraph, Splats,
    TimeCodes, UpAxis, extent,
};
use cif_usd::{ExportOptions, UsdError};

/// Values in [0, 1) without a pattern that a compressor would find.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1 << 24) as f32
    }
}

fn bounds(means: &[[f32; 3]], orientations: &[[f32; 4]], scales: &[[f32; 3]]) -> Bounds {
    extent::ellipsoid_bounds(&RigidTransform::IDENTITY, means, orientations, scales)
}

fn scene(count: usize, samples: usize) -> SceneGraph {
    let mut noise = Noise(7);
    let means: Vec<[f32; 3]> = (0..count).map(|_| [noise.next(), noise.next(), noise.next()]).collect();
    let orientations: Vec<[f32; 4]> = (0..count)
        .map(|_| {
            let q = [noise.next() + 0.1, noise.next(), noise.next(), noise.next()];
            let norm = q.iter().map(|component| component * component).sum::<f32>().sqrt();
            q.map(|component| component / norm)
        })
        .collect();
    let scales: Vec<[f32; 3]> = (0..count).map(|_| [0.01 + 0.01 * noise.next(); 3]).collect();
    let splats = Splats {
        opacities: (0..count).map(|_| noise.next()).collect(),
        sh_degree: 3,
        sh_coefficients: (0..count * 48).map(|_| noise.next() - 0.5).collect(),
        occupancies: (0..count).map(|_| noise.next()).collect(),
        identity_probabilities: (0..count).map(|_| noise.next()).collect(),
        rows: (0..count as u32).collect(),
        means,
        orientations,
        scales,
        identities: Vec::new(),
    };
    let codes: Vec<f64> = (0..samples).map(|index| index as f64).collect();
    let extent = bounds(&splats.means, &splats.orientations, &splats.scales);
    let motion = if samples > 1 {
        let moved = codes.iter().map(|&time_code| {
            let means: Vec<[f32; 3]> =
                splats.means.iter().map(|mean| mean.map(|value| value + 0.01 * time_code as f32)).collect();
            let extent = bounds(&means, &splats.orientations, &splats.scales);
            DenseSample { time_code, means, orientations: splats.orientations.clone(), scales: None, extent }
        });
        Motion::Dense(DenseMotion { track: Vec::new(), samples: moved.collect() })
    } else {
        Motion::Static
    };
    let report = MotionReport {
        model: if samples > 1 { MotionModel::Dense } else { MotionModel::Static },
        rotation: None,
        gaussians: count,
        size: 1.0,
        tolerance: 0.01,
        residual: Default::default(),
        static_residual: Default::default(),
        rigid_residual: None,
        parts_residual: None,
        parts: 0,
        samples,
        motion_bytes: 0,
        seconds: 0.0,
    };
    let node = Node {
        kind: NodeKind::Instance { id: 1, index: 0 },
        name: "cloud_001".to_owned(),
        label: "cloud".to_owned(),
        category: "cloud".to_owned(),
        taxonomies: Default::default(),
        embedding: None,
        pivot: glam::DVec3::ZERO,
        motion,
        splats,
        proxy: None,
        colliders: Vec::new(),
        visibility: Vec::new(),
        extent,
        source_frames: (0, samples - 1),
        mean_occupancy: 0.5,
        report,
        appearance: Default::default(),
    };
    SceneGraph {
        up_axis: UpAxis::Z,
        meters_per_unit: 1.0,
        frame: cif_scene::CaptureFrame::default(),
        time_codes: TimeCodes {
            times: codes.iter().map(|code| code / (samples.max(2) - 1) as f64).collect(),
            samples: codes,
            frames_per_second: 24.0,
        },
        nodes: vec![node],
        windows: Vec::new(),
        cameras: Vec::new(),
        background_color: [0.0; 3],
        sort_metric: cif_field::SortMetric::Z,
        antialiased: None,
        near: None,
        omitted: Vec::new(),
        warnings: Vec::new(),
        origin: Origin::default(),
    }
}

/// CPU seconds, user and system, and peak kilobytes of this process so far; Linux.
fn usage() -> (f64, u64) {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Fields after the name in parentheses; utime and stime are the 14th and 15th of all, in 1/100 s.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |index: usize| fields.get(index).and_then(|field| field.parse::<f64>().ok()).unwrap_or(0.0);
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .and_then(|line| line.split_whitespace().next()?.parse().ok())
        .unwrap_or(0);
    ((ticks(11) + ticks(12)) / 100.0, peak)
}

fn main() -> Result<(), UsdError> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [count, samples, path] = &arguments[..] else {
        eprintln!("usage: write_speed SPLATS SAMPLES OUT.usdc");
        std::process::exit(2);
    };
    let (Ok(count), Ok(samples)) = (count.parse::<usize>(), samples.parse::<usize>()) else {
        eprintln!("SPLATS and SAMPLES are numbers above 0");
        std::process::exit(2);
    };
    pyo3::Python::initialize();
    let graph = scene(count.max(1), samples.max(1));
    cif_usd::usd_version()?;
    let (before, _) = usage();
    let clock = std::time::Instant::now();
    let summary =
        cif_usd::export(&graph, path.as_ref(), ExportOptions { force: true, ..Default::default() })?;
    let wall = clock.elapsed().as_secs_f64();
    let (after, peak) = usage();
    println!(
        "{count} splats, {samples} samples: {:.2} CPU s, {wall:.2} s, {:.1} MB, peak {:.0} MB",
        after - before,
        summary.bytes as f64 / 1e6,
        peak as f64 / 1e3
    );
    Ok(())
}
