//! Structures that Rust and WGSL share: declared once in Rust, written out for WGSL.
//!
//! Members are 4-byte scalars, 8- or 16-byte vectors and arrays of 16-byte vectors, so that Rust's `repr(C)` and
//! WGSL's layout rules agree when every member lies at a multiple of its alignment; a test lets naga confirm sizes
//! and offsets.

/// A Rust type with its WGSL name, size and alignment.
pub trait WgslType {
    /// Name in WGSL.
    fn name() -> String;
    /// Alignment in WGSL, bytes.
    const ALIGNMENT: usize;
}

macro_rules! wgsl_type {
    ($($rust:ty => $name:literal, $alignment:literal;)*) => {
        $(impl WgslType for $rust {
            fn name() -> String {
                $name.to_owned()
            }
            const ALIGNMENT: usize = $alignment;
        })*
    };
}

wgsl_type! {
    f32 => "f32", 4;
    u32 => "u32", 4;
    i32 => "i32", 4;
    [f32; 2] => "vec2f", 8;
    [u32; 2] => "vec2u", 8;
    [f32; 4] => "vec4f", 16;
    [u32; 4] => "vec4u", 16;
}

impl<const N: usize> WgslType for [[f32; 4]; N] {
    fn name() -> String {
        format!("array<vec4f, {N}>")
    }
    const ALIGNMENT: usize = 16;
}

impl<const N: usize> WgslType for [[u32; 4]; N] {
    fn name() -> String {
        format!("array<vec4u, {N}>")
    }
    const ALIGNMENT: usize = 16;
}

/// A member of a structure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Name.
    pub name: &'static str,
    /// WGSL type.
    pub wgsl: String,
    /// Offset in Rust, bytes.
    pub offset: usize,
    /// Alignment in WGSL, bytes.
    pub alignment: usize,
}

/// A structure that both sides share.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Name in both languages.
    pub name: &'static str,
    /// Size in Rust, bytes.
    pub size: usize,
    /// Members in order.
    pub members: Vec<Member>,
}

impl Layout {
    /// The WGSL declaration.
    #[must_use]
    pub fn wgsl(&self) -> String {
        let members: String =
            self.members.iter().map(|member| format!("    {}: {},\n", member.name, member.wgsl)).collect();
        format!("struct {} {{\n{members}}}\n", self.name)
    }
}

/// A structure with a layout; made by [`shared_struct!`].
pub trait Shared: bytemuck::Pod {
    /// Its layout.
    fn layout() -> Layout;
}

/// Declares a plain structure for Rust and its WGSL twin.
#[macro_export]
macro_rules! shared_struct {
    ($(#[$meta:meta])* $visibility:vis struct $name:ident {
        $($(#[$member_meta:meta])* $member_visibility:vis $member:ident: $type:ty,)*
    }) => {
        $(#[$meta])*
        #[repr(C)]
        #[derive(Clone, Copy, Debug, Default, PartialEq, ::bytemuck::Pod, ::bytemuck::Zeroable)]
        $visibility struct $name {
            $($(#[$member_meta])* $member_visibility $member: $type,)*
        }

        impl $crate::wgpu::layout::Shared for $name {
            fn layout() -> $crate::wgpu::layout::Layout {
                $crate::wgpu::layout::Layout {
                    name: stringify!($name),
                    size: ::std::mem::size_of::<$name>(),
                    members: vec![$($crate::wgpu::layout::Member {
                        name: stringify!($member),
                        wgsl: <$type as $crate::wgpu::layout::WgslType>::name(),
                        offset: ::std::mem::offset_of!($name, $member),
                        alignment: <$type as $crate::wgpu::layout::WgslType>::ALIGNMENT,
                    },)*],
                }
            }
        }
    };
}
