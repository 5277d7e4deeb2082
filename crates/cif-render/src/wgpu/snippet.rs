//! Text that WGSL modules import.

/// Text that modules import.
#[derive(Clone, Copy, Debug)]
pub struct Snippet {
    /// Name after `#import`.
    pub name: &'static str,
    /// Makes the text.
    pub text: fn() -> String,
}
