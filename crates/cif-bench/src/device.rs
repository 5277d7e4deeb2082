//! GPU times of the stages of a step, compared with their least possible times.

use std::time::Duration;

use cif_render::Speed;
use cif_render::wgpu::Gpu;
use cif_train::floors::{StepShape, floor};
use serde::Serialize;

use crate::Error;

/// Stages of one step and what they took, in the order in which they ran.
pub type StageTimes = Vec<(&'static str, Duration)>;

/// Steps on a GPU.
pub struct OnDevice {
    name: String,
    subgroups: String,
    speed: Speed,
    stages: Vec<StageRow>,
    /// Mean wall time of a step on the device and on the processor, milliseconds.
    step_ms: [f64; 2],
}

/// A stage, mean of a step.
struct StageRow {
    name: &'static str,
    ms: f64,
    floor_ms: f64,
    bytes: f64,
    flops: f64,
    by_memory: bool,
}

/// Steps on a GPU, for programs.
#[derive(Debug, Serialize)]
pub struct DeviceReport<'a> {
    /// Name of the GPU and of its interface.
    name: &'a str,
    /// How its subgroups are used, in words.
    subgroups: &'a str,
    /// Measured memory bandwidth, bytes per second.
    bytes_per_second: f64,
    /// Measured speed of arithmetic, operations per second.
    flops_per_second: f64,
    /// Stages of a step, in the order in which they ran; empty where the GPU has no timestamps.
    stages: Vec<StageReport>,
    /// Mean wall time of a step, milliseconds.
    step_ms: f64,
    /// The same on the processor, milliseconds.
    processor_step_ms: f64,
    /// The second over the first.
    times_as_fast_as_processor: Option<f64>,
}

/// A stage on a GPU, mean of a step.
#[derive(Debug, Serialize)]
struct StageReport {
    /// Name.
    name: &'static str,
    /// Time on the device, milliseconds.
    ms: f64,
    /// Least time that its bytes and operations could take, milliseconds.
    floor_ms: f64,
    /// The second over the first, in [0, 1].
    share_of_floor: Option<f64>,
    /// Bound that decides the floor: `memory`, `arithmetic` or `latency`.
    floor_by: &'static str,
    /// Least bytes that it moves.
    bytes: f64,
    /// Least floating-point operations that it does.
    flops: f64,
}

impl OnDevice {
    /// From the stages of every measured step, what they worked on, and the mean wall time of a step here and on the
    /// processor.
    ///
    /// # Errors
    /// When the speed of the device cannot be measured.
    pub fn new(gpu: &Gpu, steps: &[StageTimes], shape: &StepShape, step_ms: [f64; 2]) -> Result<Self, Error> {
        let speed = Speed::of_device(gpu).map_err(Error::plain)?;
        Ok(Self {
            name: format!("{} ({})", gpu.facts().name, gpu.facts().interface),
            subgroups: gpu.subgroups().to_string(),
            stages: rows(steps, shape, &speed),
            speed,
            step_ms,
        })
    }

    /// For programs.
    #[must_use]
    pub fn report(&self) -> DeviceReport<'_> {
        let stage = |row: &StageRow| StageReport {
            name: row.name,
            ms: row.ms,
            floor_ms: row.floor_ms,
            share_of_floor: row.share(),
            floor_by: row.floor_by(),
            bytes: row.bytes,
            flops: row.flops,
        };
        let [here, processor] = self.step_ms;
        DeviceReport {
            name: &self.name,
            subgroups: &self.subgroups,
            bytes_per_second: self.speed.bytes_per_second,
            flops_per_second: self.speed.flops_per_second,
            stages: self.stages.iter().map(stage).collect(),
            step_ms: here,
            processor_step_ms: processor,
            times_as_fast_as_processor: (here > 0.0).then(|| processor / here),
        }
    }

    /// As a table, with what it means.
    #[must_use]
    pub fn table(&self) -> String {
        let speeds = format!(
            "\n{}: {:.1} GB/s by a copy, {:.1} GFLOP/s by multiplying and adding; subgroups are {}",
            self.name,
            self.speed.bytes_per_second / 1e9,
            self.speed.flops_per_second / 1e9,
            self.subgroups
        );
        let [here, processor] = self.step_ms;
        let stages = if self.stages.is_empty() {
            "it has no timestamps, so its stages are not timed".to_owned()
        } else {
            let heading = ["stage on the device", "ms", "floor ms", "of floor", "by", "MB", "MFLOP"];
            let mut table = comfy_table::Table::new();
            table.load_style(comfy_table::presets::NOTHING).set_header(heading);
            for row in &self.stages {
                table.add_row([
                    row.name.to_owned(),
                    format!("{:.3}", row.ms),
                    format!("{:.3}", row.floor_ms),
                    row.share().map_or_else(String::new, |share| format!("{:.0} %", 100.0 * share)),
                    row.floor_by().to_owned(),
                    format!("{:.2}", row.bytes / 1e6),
                    format!("{:.2}", row.flops / 1e6),
                ]);
            }
            let sum = |of: fn(&StageRow) -> f64| self.stages.iter().map(of).sum::<f64>();
            let (ms, floor) = (sum(|row| row.ms), sum(|row| row.floor_ms));
            table.add_row([
                "all".to_owned(),
                format!("{ms:.3}"),
                format!("{floor:.3}"),
                if ms > 0.0 { format!("{:.0} %", 100.0 * floor / ms) } else { String::new() },
                String::new(),
                format!("{:.2}", sum(|row| row.bytes) / 1e6),
                format!("{:.2}", sum(|row| row.flops) / 1e6),
            ]);
            format!(
                "{table}\nthe floor is what the stage has to move and to compute at the least, at the speeds above; steps wait \
                 for the device here, which they do not in training"
            )
        };
        let (faster, times) =
            if here < processor { ("device", processor / here) } else { ("processor", here / processor) };
        format!(
            "{speeds}\n{stages}\nthe processor does such a step in {processor:.3} ms, the device in {here:.3}: the {faster} is \
             {times:.1} times faster"
        )
    }
}

impl StageRow {
    /// Share of the floor that is reached.
    fn share(&self) -> Option<f64> {
        (self.ms > 0.0).then(|| self.floor_ms / self.ms)
    }

    fn floor_by(&self) -> &'static str {
        match (self.floor_ms > 0.0, self.by_memory) {
            (false, _) => "latency",
            (true, true) => "memory",
            (true, false) => "arithmetic",
        }
    }
}

/// Means over steps, by stage, in the order in which stages first ran; those without a floor are left out.
fn rows(steps: &[StageTimes], shape: &StepShape, speed: &Speed) -> Vec<StageRow> {
    let mut rows: Vec<StageRow> = Vec::new();
    for (name, time) in steps.iter().flatten() {
        let ms = 1e3 * time.as_secs_f64() / steps.len() as f64;
        if let Some(row) = rows.iter_mut().find(|row| row.name == *name) {
            row.ms += ms;
        } else if let Some(floor) = floor(name, shape) {
            rows.push(StageRow {
                name,
                ms,
                floor_ms: 1e3 * floor.seconds(speed),
                bytes: floor.bytes,
                flops: floor.flops,
                by_memory: floor.is_by_memory(speed),
            });
        }
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_are_means_over_steps_listed_with_their_floors() {
        let ms = Duration::from_millis;
        let steps = [
            vec![("project", ms(2)), ("accumulate", ms(1)), ("accumulate", ms(2)), ("judge", ms(1))],
            vec![("project", ms(4)), ("accumulate", ms(3))],
        ];
        let shape = StepShape { views: 1.0, gaussians: 1000.0, ..StepShape::default() };
        let speed = Speed { bytes_per_second: 1e8, flops_per_second: 1e9 };
        let rows = rows(&steps, &shape, &speed);
        assert_eq!(rows.iter().map(|row| row.name).collect::<Vec<_>>(), ["project", "accumulate", "judge"]);
        assert!((rows[0].ms - 3.0).abs() < 1e-9 && (rows[1].ms - 3.0).abs() < 1e-9);
        // 120 kB at 100 MB/s, next to 220 kFLOP at 1 GFLOP/s.
        assert!((rows[0].floor_ms - 1.2).abs() < 1e-9 && rows[0].floor_by() == "memory");
        assert!((rows[0].share().unwrap() - 0.4).abs() < 1e-9);
        assert_eq!(rows[2].floor_by(), "latency");
        let slow = Speed { flops_per_second: 1e7, ..speed };
        assert_eq!(super::rows(&steps, &shape, &slow)[0].floor_by(), "arithmetic");
    }
}
