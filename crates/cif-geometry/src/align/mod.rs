//! Alignment of point sets: rigid, plain and robust, and by a similarity.

pub mod procrustes;
pub mod similarity;
