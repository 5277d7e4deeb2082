//! Objects with poses that appear or vanish: they are hidden while masks and images show that they are not there.

use cif_field::Field;
use cif_field::tracks::VisibilityStep;
use cif_render::cpu::{Renderer, SimdLevel};
use cif_render::{Channels, RenderSettings};

use crate::error::TrainError;
use crate::events::TrainEvent;
use crate::phase::Phase;
use crate::sightings::Sightings;
use crate::state::State;

/// Most views that show whether an object is there while no mask shows it.
const LOOKS: usize = 12;

/// Difference of a channel from which a pixel shows whether an object is there, and fewest such pixels.
const SHOWS: f32 = 0.04;
const FEWEST_PIXELS: usize = 30;

/// Largest squared error without the object, of that with it, at which it is not there: what its masks miss is
/// reconstructed with its surroundings, so that both are about the same.
const ABSENT: f64 = 0.5;

/// An object with poses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Posed {
    /// Dense index + 1.
    pub label: u16,
    /// Its group.
    pub group: u32,
}

/// Hides objects before they appear and after they vanish inside the view, by their masks, where the images are
/// explained better without them; returns what there is to say about it.
pub(crate) fn hide_absent(
    state: &mut State,
    simd: SimdLevel,
    objects: &[Posed],
) -> Result<Vec<TrainEvent>, TrainError> {
    if objects.is_empty() {
        return Ok(Vec::new());
    }
    let mut found = Vec::new();
    let phase = state.phases.enter(Phase::Presence, objects.len());
    let observations = observations(state)?;
    for Posed { label, group } in objects {
        let seen = observations.of(*label);
        let Some([first, last]) = seen.first().zip(seen.last()).map(|(a, b)| [a, b].map(|o| o.time_index))
        else {
            continue;
        };
        let mut steps = Vec::new();
        let times = &state.dataset.times;
        if observations.appears(*label) && is_absent(state, simd, *group, |time| time < first)? {
            let before = last_time_before(state, first);
            let appears = times[(before + first).div_ceil(2)];
            steps.extend([(times[0], false), (appears, true)]);
        }
        if observations.vanishes(*label) && is_absent(state, simd, *group, |time| time > last)? {
            let after = first_time_after(state, last);
            if steps.is_empty() {
                steps.push((times[0], true));
            }
            steps.push((times[(last + after).div_ceil(2)], false));
        }
        found.push((*label, *group, steps));
        state.phases.advance();
    }
    drop(phase);
    let mut notes = Vec::new();
    for (label, group, steps) in found.into_iter().filter(|(.., steps)| !steps.is_empty()) {
        let Some(tracks) = &mut state.field.tracks else { continue };
        let name = &state.field.instances[usize::from(label) - 1].label;
        notes.push(TrainEvent::note(format!(
            "{name} is not there all the time, by its masks and by what is seen in its place: hidden meanwhile"
        )));
        tracks.groups[group as usize].visibility =
            steps.into_iter().map(|(time, visible)| VisibilityStep { time, visible }).collect();
    }
    Ok(notes)
}

/// Where the masks of training views show objects, by label.
fn observations(state: &State) -> Result<Sightings<'_>, TrainError> {
    let mut views: Vec<usize> = (0..state.frames.len()).collect();
    views.sort_by_key(|view| state.dataset.frames[state.frames.index(*view)].time_index);
    let mut observations = Sightings::default();
    let masks = state.frames.masks(&state.dataset, &state.phases)?;
    for view in views {
        let frame = &state.dataset.frames[state.frames.index(view)];
        if let Some(table) = &masks[view] {
            let seen = table.observations(&frame.camera, frame.time_index);
            observations.add(&frame.camera_name, frame.time_index, seen);
        }
    }
    Ok(observations)
}

/// The last time of training views before one, and the first after one.
fn last_time_before(state: &State, time: usize) -> usize {
    training_times(state).filter(|other| *other < time).max().unwrap_or(time)
}

fn first_time_after(state: &State, time: usize) -> usize {
    training_times(state).filter(|other| *other > time).min().unwrap_or(time)
}

fn training_times(state: &State) -> impl Iterator<Item = usize> {
    (0..state.frames.len()).map(|view| state.dataset.frames[state.frames.index(view)].time_index)
}

/// True where training views at some times are explained far better without the Gaussians of a group, which are in the
/// nearest of their poses.
fn is_absent(
    state: &State,
    simd: SimdLevel,
    group: u32,
    at: impl Fn(usize) -> bool,
) -> Result<bool, TrainError> {
    let time_of = |view: &usize| state.dataset.frames[state.frames.index(*view)].time_index;
    let views: Vec<usize> = (0..state.frames.len()).filter(|view| at(time_of(view))).collect();
    let without = hidden(&state.field, group);
    let settings = RenderSettings { deform: false, ..state.color_settings() };
    let channels = Channels { depth: false, instances: false };
    let mut renderer = Renderer::new(simd);
    let (mut errors, mut pixels) = ([0.0_f64; 2], 0);
    for view in views.iter().step_by(views.len().div_ceil(LOOKS).max(1)) {
        state.phases.check()?;
        let frame = &state.dataset.frames[state.frames.index(*view)];
        let truth = state.frames.get(&state.dataset, *view)?;
        let [with, without] = [&state.field, &without]
            .map(|field| renderer.render(field, &frame.camera, frame.time, &settings, channels).color);
        for ((with, without), truth) in with.pixels.iter().zip(&without.pixels).zip(&truth.image.pixels) {
            let differs = (0..3).any(|channel| (with[channel] - without[channel]).abs() > SHOWS);
            if !differs {
                continue;
            }
            pixels += 1;
            for (error, color) in errors.iter_mut().zip([with, without]) {
                let squares = (0..3).map(|c| f64::from(color[c] - f32::from(truth[c]) / 255.0).powi(2));
                *error += squares.sum::<f64>();
            }
        }
    }
    Ok(pixels >= FEWEST_PIXELS && errors[1] < ABSENT * errors[0])
}

/// The field without the Gaussians of a group.
fn hidden(field: &Field, group: u32) -> Field {
    let mut field = field.clone();
    if let Some(tracks) = &mut field.tracks {
        let never = VisibilityStep { time: 0.0, visible: false };
        tracks.groups[group as usize].visibility = vec![never];
    }
    field
}
