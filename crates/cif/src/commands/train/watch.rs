//! `cif train --view`: a run in a browser while it goes on.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use cif_field::Field;
use cif_scene::{SceneOptions, Tolerance};
use cif_train::{TrainEvent, Trainer, TrainerView};
use cif_web::{Page, describe};
use clap::ValueEnum;
use serde::Serialize;

use crate::commands::view::{Server, Shown};
use crate::error::Error;
use crate::formats::name_of;
use crate::messages::{note, warning};
use crate::pictures::instance_color;

/// Time of the run over that of preparing what the page shows, at least: 2.5 % go there.
const SHARE: u32 = 40;

/// Least pause between two states that are shown.
const PAUSE: Duration = Duration::from_secs(3);

/// Times at which a state is shown.
const TIMES: usize = 12;

/// Time in which a page asks for the last status, which it does once a second.
const FAREWELL: Duration = Duration::from_millis(2_500);

/// Most points of the curve; every other one goes when there are more.
const MOST_POINTS: usize = 400;

/// What is done with the page of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Opening {
    /// It is opened in a browser
    Open,
    /// Its address is printed
    Address,
}

/// A page that shows a run.
pub(super) struct Watch {
    server: Arc<Server>,
    is_over: Arc<AtomicBool>,
    answers: Mutex<Option<JoinHandle<()>>>,
    state: Mutex<State>,
    title: String,
}

struct State {
    start: Instant,
    /// When the next state may be shown.
    next: Instant,
    status: Status,
}

/// How far a run is.
#[derive(Clone, Debug, Default, Serialize)]
struct Status {
    /// Counts the states of the scene; the page asks for a new one.
    revision: u32,
    /// `running`, `stopping`, `saved` or `failed`.
    state: &'static str,
    /// What goes on.
    phase: String,
    /// Units of it that are done, and all; 0 where they are not counted.
    done: u64,
    total: u64,
    /// Time since the start of the command, seconds.
    seconds: f64,
    /// Estimated time to the end, seconds.
    eta_s: Option<f64>,
    /// Steps per second.
    rate: Option<f64>,
    /// Loss of the last step.
    loss: Option<f64>,
    /// PSNR of training views, running mean, dB.
    psnr: Option<f64>,
    /// Gaussians.
    gaussians: usize,
    /// Time that went into preparing what is shown, seconds.
    showing_s: f64,
    /// Seconds and PSNR of training views.
    curve: Vec<[f64; 2]>,
    /// Seconds and PSNR of held-out frames.
    held_out: Vec<[f64; 2]>,
    /// Seconds by phase.
    phases: BTreeMap<String, f64>,
}

impl Watch {
    /// Opens a page for the run that writes a scene.
    ///
    /// # Errors
    /// When no page can be served.
    pub(super) fn start(output: &Path, opening: Opening) -> Result<Arc<Self>, Error> {
        let title = name_of(output);
        let server = Arc::new(Server::start(Shown::of(Page::empty(&title), None), 0)?);
        let address = server.address();
        let is_over = Arc::new(AtomicBool::new(false));
        let answers = std::thread::spawn({
            let (server, is_over) = (Arc::clone(&server), Arc::clone(&is_over));
            move || server.serve(|| is_over.load(Ordering::Relaxed))
        });
        let now = Instant::now();
        let status = Status { state: "running", phase: "open".into(), ..Status::default() };
        let watch = Self {
            server,
            is_over,
            answers: Mutex::new(Some(answers)),
            state: Mutex::new(State { start: now, next: now, status }),
            title,
        };
        watch.publish();
        note!("the run can be watched at {address}");
        if opening == Opening::Open && open::that_detached(&address).is_err() {
            warning!("no browser could be started; open the address above in one");
        }
        Ok(Arc::new(watch))
    }

    /// True after somebody has asked the page to stop the run.
    pub(super) fn is_stopped(&self) -> bool {
        self.server.is_stopped()
    }

    /// Takes an event of the phases of the run.
    pub(super) fn phase(&self, event: &TrainEvent) {
        let mut state = self.state();
        let status = &mut state.status;
        match event {
            TrainEvent::PhaseStarted { phase, total } => {
                (status.phase, status.done, status.total) = (phase.name().to_owned(), 0, *total);
                (status.eta_s, status.rate) = (None, None);
            }
            TrainEvent::PhaseProgress { phase, done, total, eta_s, .. } => {
                (status.phase, status.done, status.total) = (phase.name().to_owned(), *done, *total);
                status.eta_s = *eta_s;
            }
            TrainEvent::PhaseEnded { phase, wall_s, .. } => {
                *status.phases.entry(phase.name().to_owned()).or_default() += wall_s;
            }
            _ => return,
        }
        drop(state);
        self.publish();
    }

    /// Takes an event of the run.
    pub(super) fn event(&self, event: &TrainEvent, view: &TrainerView<'_>) {
        let mut state = self.state();
        let seconds = state.start.elapsed().as_secs_f64();
        let status = &mut state.status;
        match event {
            TrainEvent::StageStarted { stage, iteration, iterations, gaussians } => {
                (status.phase, status.gaussians) = (stage.to_string(), *gaussians);
                (status.done, status.total) = (u64::from(*iteration), u64::from(*iterations));
                self.show(&mut state, view.field());
            }
            TrainEvent::Step {
                stage,
                iteration,
                iterations,
                loss,
                gaussians,
                psnr,
                iterations_per_second,
                eta_s,
                ..
            } => {
                (status.phase, status.gaussians) = (stage.to_string(), *gaussians);
                (status.done, status.total) = (u64::from(*iteration), u64::from(*iterations));
                (status.loss, status.psnr) = (Some(*loss), Some(*psnr));
                (status.rate, status.eta_s) = (Some(*iterations_per_second), Some(*eta_s));
                add(&mut status.curve, [seconds, *psnr]);
                status.phases = view
                    .phases()
                    .times()
                    .iter()
                    .map(|(phase, spent)| (phase.name().to_owned(), spent.wall_s))
                    .collect();
                self.show(&mut state, view.field());
            }
            TrainEvent::Measured { point, .. } => {
                status.held_out.extend(point.psnr.map(|psnr| [seconds, psnr]));
            }
            _ => return,
        }
        drop(state);
        self.publish();
    }

    /// Shows the field, where that is due and somebody looks.
    fn show(&self, state: &mut State, field: &Field) {
        let start = Instant::now();
        if start < state.next || !self.server.is_watched() {
            return;
        }
        let options = SceneOptions {
            frame_step: field.timeline.times.len().div_ceil(TIMES).max(1),
            tolerance: Tolerance::Percent(1.0),
            hulls_per_instance: 0,
            proxy_points: 0,
            max_parts: 2,
            ..SceneOptions::default()
        };
        // A field of which nothing can be seen yet is none to show.
        let Ok(graph) = cif_scene::build(field, &options) else { return };
        let mut page = describe(&graph, &self.title, &BTreeMap::new(), instance_color);
        page.document.live = true;
        if self.server.show(page).is_ok() {
            state.status.revision += 1;
        }
        let spent = start.elapsed();
        state.status.showing_s += spent.as_secs_f64();
        state.next = Instant::now() + PAUSE.max(SHARE * spent);
    }

    /// Shows the last state, and closes the page.
    pub(super) fn end(&self, succeeded: bool, trainer: &Trainer) {
        let mut state = self.state();
        let status = &mut state.status;
        status.state = if succeeded { "saved" } else { "failed" };
        status.eta_s = None;
        status.phases = trainer.wall_s_by_phase();
        let showing_s = status.showing_s;
        state.next = Instant::now();
        self.show(&mut state, trainer.field());
        drop(state);
        self.publish();
        if self.server.is_watched() {
            std::thread::sleep(FAREWELL);
        }
        note!("{showing_s:.1} s went into what the page showed while the run went on");
    }

    /// Gives the page the present status.
    fn publish(&self) {
        let mut state = self.state();
        state.status.seconds = state.start.elapsed().as_secs_f64();
        if state.status.state == "running" && self.server.is_stopped() {
            state.status.state = "stopping";
        }
        if let Ok(status) = serde_json::to_vec(&state.status) {
            self.server.set_status(status);
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        let answers = self.answers.lock().unwrap_or_else(PoisonError::into_inner).take();
        // What its threads answered last was said already.
        drop(answers.map(JoinHandle::join));
    }
}

/// Adds a point to a curve, which stays short.
fn add(curve: &mut Vec<[f64; 2]>, point: [f64; 2]) {
    curve.push(point);
    if curve.len() > MOST_POINTS {
        let mut behind = curve.len();
        curve.retain(|_| {
            behind -= 1;
            behind.is_multiple_of(2)
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_stay_short_and_keep_their_end() {
        let mut curve = Vec::new();
        for k in 0..5_000 {
            add(&mut curve, [f64::from(k), 1.0]);
            assert!(curve.len() <= MOST_POINTS && curve.last() == Some(&[f64::from(k), 1.0]));
        }
        assert!(curve.len() > MOST_POINTS / 2 - 1 && curve.is_sorted());
    }
}
