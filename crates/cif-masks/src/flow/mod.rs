//! Dense optical flow by inverse search.
//!
//! Source: Kroeger, Timofte, Dai, Van Gool, "Fast Optical Flow using Dense Inverse Search", ECCV 2016 (DIS). Coarse to
//! fine: on every level, patches on a grid are aligned by inverse compositional Gauss-Newton ([`patches`]), their
//! displacements are blended into a dense field ([`dense`]), and the field is refined by a few rounds of a robust
//! variational method ([`refine`]).

mod dense;
mod field;
mod patches;
mod pyramid;
mod refine;

pub use self::field::Flow;
pub use self::pyramid::Pyramid;

/// The flow from the first image to the second.
///
/// # Panics
/// When the images differ in size.
#[must_use]
pub fn flow(first: &Pyramid, second: &Pyramid) -> Flow {
    let size = |pyramid: &Pyramid| {
        let finest = &pyramid.levels[0].brightness;
        (finest.width, finest.height)
    };
    assert_eq!(size(first), size(second), "flow between images of different sizes");
    let mut field: Option<Flow> = None;
    for (a, b) in first.levels.iter().zip(&second.levels).rev() {
        let (width, height) = (a.brightness.width, a.brightness.height);
        let start = match &field {
            Some(coarse) => coarse.resized(width, height),
            None => Flow::zero(width, height),
        };
        let found = patches::search(a, &b.brightness, &start);
        let mut level = dense::blend(a, &b.brightness, &found, start);
        refine::refine(a, b, &mut level);
        field = Some(level);
    }
    field.unwrap_or_else(|| Flow::zero(size(first).0, size(first).1))
}
