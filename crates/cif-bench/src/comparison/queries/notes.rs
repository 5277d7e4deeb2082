//! Remarks that readers of the answers need.

use super::super::tables::missing_note;
use super::{Queries, Rule};

impl Queries {
    /// Notes for readers of the tables.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        let mut notes = vec![
            "Answers are compared with the masks of the instances that the file of questions names: mAcc is the percent of \
             all pixels that agree, mIoU the intersection over union, both means over the held-out frames that show the \
             answer, and over seeds with the sample standard deviation; the best of a column is marked, among lines that \
             were answered by the same rule. The paper scored the same, against masks of its detector."
                .to_owned(),
            "labels: the instances that have the most words of the question in their labels, classes and taxonomies \
             (cif query --text), pixel by pixel as the head decodes them, where its foreground or probability is \
             at least a half. Heads without a class for unlabelled pixels (VLGS, Dr. Splat, Trace3D) give the \
             background to instances too, which counts against their answers."
                .to_owned(),
        ];
        if self.has_models {
            notes.push(
                "reproject: the instances of which more than half lies inside the masks that Grounding DINO and SAM \
                 make of the question on the training frames (cif query --prompt); the answer in a view are the \
                 pixels that are mostly of their Gaussians, where the foreground is at least a half. grouping: those \
                 with more than 0.7 of their pixels inside the mask of the first held-out view as the scene renders \
                 it; the answer are the pixels with a probability above 0.2, as in the released code of Gaussian \
                 Grouping, which the paper cites for this task. Both go by the one label that a head gives every \
                 Gaussian."
                    .to_owned(),
            );
        } else {
            notes.push(
                "No models were given (--models DIR), so that nothing was asked of a detector: lines by reproject and \
                 grouping, which are how the paper asked, are left out."
                    .to_owned(),
            );
        }
        if self.answers.iter().any(|answer| answer.by == Rule::Relevance) {
            notes.push(
                "relevance: 4D LangSplat does not separate instances; a pixel is in its answer where the features that it \
                 learnt of maps that were given are relevant for the code of the question. It is its time-agnostic field \
                 alone, of one granularity, with relevance in the space of the codes, because no decoder is given."
                    .to_owned(),
            );
        }
        if !self.without_maps.is_empty() {
            notes.push(format!("4D LangSplat was not asked: {}.", self.without_maps.join("; ")));
        }
        notes.extend(missing_note(&self.missing.iter().collect::<Vec<_>>(), &self.camera));
        notes
    }
}
