//! The work of the process that runs a model: questions come from its standard input, answers go to its standard output.

use std::io::{self, BufReader, Read, Write};

use super::messages::{Answer, Question, receive, send};
use super::place::Place;
use crate::Tensor;

/// Answers the questions of another process until they end.
///
/// # Errors
/// When that process is gone.
pub fn serve(questions: impl Read, mut answers: impl Write) -> io::Result<()> {
    let mut questions = BufReader::new(questions);
    let mut place = Place::here();
    while let Some((question, tensors)) = receive(&mut questions)? {
        let (answer, outputs) = match answer(&mut place, question, tensors) {
            Ok(answered) => answered,
            Err(problem) => (Answer::Failed(problem), Vec::new()),
        };
        send(&mut answers, answer, &outputs)?;
    }
    Ok(())
}

fn answer(
    place: &mut Place,
    question: Question,
    tensors: Vec<Tensor>,
) -> Result<(Answer, Vec<Tensor>), String> {
    let answer = match question {
        Question::Library(library) => place.load_library(&library).map(|()| Answer::Ready)?,
        Question::Model { file, threads } => Answer::Declared(place.open_with(&file, threads)?),
        Question::Run { names, wanted } => {
            let given = names.into_iter().zip(tensors).collect();
            return Ok((Answer::Outputs, place.run(given, &wanted)?));
        }
        Question::Tokenizer(text) => place.open_tokenizer(text).map(|()| Answer::Ready)?,
        Question::Read(text) => Answer::Reading(place.read(&text)?),
    };
    Ok((answer, Vec::new()))
}
