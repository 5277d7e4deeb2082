//! When each window lasts, and which times it shares with its neighbours.

use crate::SceneError;
use crate::graph::SceneGraph;

/// Time codes of a window.
#[derive(Clone, Debug)]
pub(super) struct Span {
    /// First and last time code while it lasts, before the next window.
    pub(super) start: f64,
    pub(super) end: f64,
    /// Time codes that it sees.
    pub(super) seen: Vec<f64>,
    /// Last time code that the previous window sees, and the first that the next one does.
    previous_end: Option<f64>,
    next_start: Option<f64>,
}

impl Span {
    pub(super) fn lasts_at(&self, code: f64) -> bool {
        (self.start..=self.end).contains(&code)
    }

    /// Those of some time codes while it lasts, and its ends, ascending.
    pub(super) fn codes(&self, codes: impl IntoIterator<Item = f64>) -> Vec<f64> {
        let inside = codes.into_iter().filter(|code| self.lasts_at(*code));
        let mut codes: Vec<f64> = inside.chain([self.start, self.end]).collect();
        codes.sort_by(f64::total_cmp);
        codes.dedup();
        codes
    }

    /// Times that it shares with the window before it.
    pub(super) fn shared_with_previous(&self) -> impl Iterator<Item = f64> + '_ {
        let end = self.previous_end;
        self.seen.iter().copied().filter(move |code| end.is_some_and(|end| *code <= end))
    }

    /// Times while it lasts that it shares with a neighbour.
    pub(super) fn shared(&self) -> impl Iterator<Item = f64> + '_ {
        self.seen
            .iter()
            .copied()
            .filter(|code| self.lasts_at(*code) && self.share_of_neighbour(*code).is_some())
    }

    /// The neighbour that sees a time as well, `true` for the next one, and its share in the mixture: one half where the
    /// windows meet, none where it sees no more.
    pub(super) fn share_of_neighbour(&self, code: f64) -> Option<(bool, f64)> {
        let first = self.seen.first().copied().unwrap_or(self.start);
        let last = self.seen.last().copied().unwrap_or(self.end);
        if let Some(end) = self.previous_end.filter(|end| code <= *end) {
            return Some((false, (end - code + 1.0) / (end - first + 2.0)));
        }
        let start = self.next_start.filter(|start| code >= *start)?;
        Some((true, (code - start + 1.0) / (last - start + 2.0)))
    }
}

/// Where windows begin and end: half way between the first time of one and the last of the one before it.
pub(super) fn spans(graphs: &[SceneGraph]) -> Result<Vec<Span>, SceneError> {
    let wrong = |what: String| Err(SceneError::Windows { what });
    if graphs.len() < 2 {
        return wrong("there is one; give them all".to_owned());
    }
    let mut spans: Vec<Span> = graphs
        .iter()
        .map(|graph| Span {
            start: graph.time_codes.start(),
            end: graph.time_codes.end(),
            seen: graph.time_codes.samples.clone(),
            previous_end: None,
            next_start: None,
        })
        .collect();
    for index in 1..graphs.len() {
        let (before, now) = (&graphs[index - 1], &graphs[index]);
        let (last, first) = (before.time_codes.end(), now.time_codes.start());
        if (before.frame, before.meters_per_unit, before.up_axis)
            != (now.frame, now.meters_per_unit, now.up_axis)
        {
            return wrong(
                "they differ in where they lie in the world, in its unit or its up axis".to_owned(),
            );
        }
        if first > last {
            return wrong(format!(
                "none of them has the frames between {last} and {first}; give that window, too"
            ));
        }
        if now.time_codes.end() <= last {
            return wrong(format!(
                "two of them have frames {first} to {}; give each once",
                now.time_codes.end()
            ));
        }
        let middle = 0.5 * (first + last);
        let begins = |code: &&f64| **code > middle;
        let start = now.time_codes.samples.iter().find(begins).copied().unwrap_or(last);
        let end = before.time_codes.samples.iter().rev().find(|code| **code < start).copied();
        let Some(end) = end.filter(|end| *end >= spans[index - 1].start) else {
            return wrong(format!("frames {first} to {last} are in three of them; give each once"));
        };
        (spans[index - 1].end, spans[index].start) = (end, start);
        (spans[index - 1].next_start, spans[index].previous_end) = (Some(first), Some(last));
    }
    Ok(spans)
}
