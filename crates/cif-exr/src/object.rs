//! Objects of a Cryptomatte.

/// An instance of the scene, by dense index.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Object {
    /// Mask value.
    pub id: u16,
    /// Name in the Cryptomatte, unique.
    pub name: String,
}
