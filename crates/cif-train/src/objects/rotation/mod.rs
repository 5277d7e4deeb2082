//! Which rotation of an object its pictures show, and whether they do. Source: motion reference, second part.
//!
//! | file | answers |
//! |---|---|
//! | `evidence` | which pixels judge |
//! | `hull` | the shape of an object under a hypothesis, and what pixels see of it |
//! | `judge` | which rotation they show, and whether they do |
//! | `turning`, `revolved` | how a ball turns that stays in place, and a solid of revolution that rolls or turns |
//! | `painted` | which turns of a surface explain its paint |
//! | `shown` | whether they are what the pictures show |
//! | `layered`, `shaded` | how well paint and light explain pixels left out |
//! | `folds`, `compare` | which pixels are left out, and by how many standard errors one hypothesis is better |

mod compare;
mod evidence;
mod folds;
mod hull;
mod judge;
mod layered;
mod painted;
mod revolved;
mod shaded;
mod shown;
#[cfg(test)]
mod tests;
mod turning;

pub(super) use self::hull::Course;
pub(super) use self::judge::{Rivals, shown};
pub(super) use self::painted::Turning;
pub(super) use self::revolved::Revolving;
pub(super) use self::turning::{Ball, turning};
