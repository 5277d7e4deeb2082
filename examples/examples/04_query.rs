//! Asking what is at a place and a time: along a line through the scene.

use anyhow::Context;
use cif_field::Field;
use glam::DVec3;

fn main() -> anyhow::Result<()> {
    let path = cif_examples::output("tabletop-mini.cif")?;
    let field = Field::load(&path).context("run the example 02_train first")?;
    let points: Vec<DVec3> =
        (0..=10).map(|step| DVec3::new(-0.5 + 0.1 * f64::from(step), -0.1, 0.04)).collect();
    for time in [0.0, 1.0] {
        println!("at time {time}");
        for (point, answer) in points.iter().zip(field.query(&points, time)) {
            let name =
                answer.instance().map_or("nothing", |index| &field.instances[usize::from(index)].label);
            println!(
                "  ({:>5.2}, {:.2}, {:.2})  existence {:.3}  {name}",
                point.x, point.y, point.z, answer.existence
            );
        }
    }
    Ok(())
}
