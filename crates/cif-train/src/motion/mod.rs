//! How objects move, by evidence. Source: motion reference, second part.
//!
//! | file | answers |
//! |---|---|
//! | `evidence` | which pixels judge |
//! | `hull` | the shape of an object under a hypothesis, and what pixels see of it |
//! | `judge` | which rotation they show, and whether they do |
//! | `pauses` | when what turns in place turns |

mod evidence;
mod hull;
mod judge;
mod pauses;
#[cfg(test)]
mod tests;

#[cfg(test)]
pub(crate) use self::judge::Course;
pub(crate) use self::judge::Judge;
