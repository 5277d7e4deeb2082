//! Motion of a node: the poses that its field records ([`recorded`]), or else a fit of a static model and of one rigid
//! body to a group of Gaussians.
//!
//! Two passes over the sampled times, so that no more than one time's Gaussians are in memory:
//! 1. poses against the shape at the reference time, which give the mean shape (in the world for static, in
//!    the moving frame for rigid): the noise of one time must not become the shape;
//! 2. poses against the mean shape, and the residuals of both models.
//!
//! Parts of a body are groups of their own, with the same two passes.

pub(crate) mod choose;
pub(crate) mod dense;
pub mod group;
pub mod keys;
pub mod loose;
pub mod parts;
pub(crate) mod recorded;
pub mod residuals;
pub(crate) mod time_map;
pub mod velocity;
