use super::super::*;
#[test]
#[ignore]
fn probe() {
    let path = std::env::var("PROBE").unwrap();
    let only: Vec<u16> = std::env::var("LABELS")
        .map(|l| l.split(',').map(|v| v.parse().unwrap()).collect())
        .unwrap_or_default();
    let dataset = Dataset::open(&path, &cif_dataset::OpenOptions::default()).unwrap();
    let stop = crate::stop::Stop::default();
    let frames = FrameStore::open(&dataset, [0.0; 3], 1 << 30, &stop).unwrap();
    let plane = support(&dataset, &dataset.points.positions, 0);
    for label in 1..=dataset.instances.len() as u16 {
        if !only.is_empty() && !only.contains(&label) {
            continue;
        }
        let start = std::time::Instant::now();
        let mut views = Vec::new();
        for k in 0..frames.len() {
            let frame = &dataset.frames[frames.index(k)];
            let data = frames.get(&dataset, k).unwrap();
            views.extend(ObjectView::new(label, frame.time_index, &frame.camera, &data));
        }
        views.sort_by_key(|view| view.time_index);
        view::set_visible(&mut views);
        let Some(outline) = outline::outline(&views, plane.as_ref()) else { continue };
        let surroundings = Surroundings {
            plane: plane.as_ref(),
            times: dataset.times.len(),
            near: 0.05,
            seed: 0,
            gaussians: 400,
            stop: &stop,
        };
        let object = Object { label, views: &views, outline: &outline, is_told: false, surroundings };
        eprintln!("== {} {} size {:.3}", label, dataset.instances[label as usize - 1].label, outline.size());
        let found = super::find(object).unwrap();
        eprintln!(
            "== {label} {:?} {:.1} s",
            found.map(|f| (f.told(), f.hinge.axis, f.hinge.point, f.errors)),
            start.elapsed().as_secs_f64()
        );
    }
}
