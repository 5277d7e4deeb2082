//! Numbers of accessors: every component type, strides, sparse values; checked against the bytes that are there
//! before memory is taken.

use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;

use super::source::Source;
use crate::GltfError;

/// Count and component types that the caller expects of an accessor.
#[derive(Clone, Copy)]
pub(crate) struct Expected<'a> {
    /// Node, mesh or attribute that uses it, for messages.
    pub(crate) object: &'a str,
    /// Number of elements; `None` for any.
    pub(crate) count: Option<usize>,
    /// Allowed component types; `true` where integers must be normalised, `false` where they must not.
    pub(crate) types: &'a [(ComponentType, bool)],
}

/// Any number, normalised or not.
pub(crate) const ANY: [(ComponentType, bool); 10] = [
    (ComponentType::F32, false),
    (ComponentType::I8, false),
    (ComponentType::U8, false),
    (ComponentType::I16, false),
    (ComponentType::U16, false),
    (ComponentType::U32, false),
    (ComponentType::I8, true),
    (ComponentType::U8, true),
    (ComponentType::I16, true),
    (ComponentType::U16, true),
];

/// Elements in bytes.
struct Layout<'a> {
    bytes: &'a [u8],
    stride: usize,
}

impl Source {
    /// Elements of `N` numbers. Integers become floats, normalised ones in [0, 1] or [-1, 1].
    pub(crate) fn numbers<const N: usize>(
        &self,
        index: usize,
        expected: &Expected<'_>,
    ) -> Result<Vec<[f32; N]>, GltfError> {
        self.try_numbers(index, expected)
            .map_err(|what| self.invalid(format!("{}, accessor {index}", expected.object), what))
    }

    fn try_numbers<const N: usize>(
        &self,
        index: usize,
        expected: &Expected<'_>,
    ) -> Result<Vec<[f32; N]>, String> {
        let accessors = &self.root.accessors;
        let Some(accessor) = accessors.get(index) else {
            return Err(format!("the file has {} accessors; export the file again", accessors.len()));
        };
        let (Checked::Valid(component), Checked::Valid(kind)) =
            (accessor.component_type.as_ref(), accessor.type_.as_ref())
        else {
            return Err("its componentType or type is none of glTF".to_owned());
        };
        let component = component.0;
        if width(*kind) != N {
            return Err(format!("it holds {kind:?}, but elements of {N} numbers are expected"));
        }
        if !expected.types.contains(&(component, accessor.normalized)) {
            let word = if accessor.normalized { "normalised " } else { "" };
            return Err(format!("{word}{component:?} is not allowed for it; export it as float"));
        }
        let count = usize::try_from(accessor.count.0).map_err(|_| "its count is too large".to_owned())?;
        if let Some(needed) = expected.count
            && needed != count
        {
            return Err(format!("{count} values for {needed} splats or keys; export the file again"));
        }
        let size = component.size() * N;
        let mut values = match accessor.buffer_view {
            Some(view) => {
                let stride = self.root.buffer_views.get(view.value()).and_then(|view| view.byte_stride);
                let offset = accessor.byte_offset.unwrap_or_default().0;
                let stride = stride.map_or(size, |stride| stride.0);
                let layout = self.layout(view.value(), offset, stride, size, count)?;
                decode(&layout, component, accessor.normalized, count)
            }
            // Zeros need no bytes, so their number is held against the file.
            None if count as u64 > self.bytes => {
                return Err(format!("{count} values are announced in a file of {} bytes", self.bytes));
            }
            None => vec![[0.0; N]; count],
        };
        if let Some(sparse) = &accessor.sparse {
            let changed = usize::try_from(sparse.count.0).map_err(|_| "its sparse count is too large")?;
            let Checked::Valid(kind) = sparse.indices.component_type.as_ref() else {
                return Err("its sparse indices have a componentType that is none of glTF".to_owned());
            };
            let kind = kind.0;
            let at = sparse.indices.byte_offset.0;
            let indices =
                self.layout(sparse.indices.buffer_view.value(), at, kind.size(), kind.size(), changed)?;
            let at = sparse.values.byte_offset.0;
            let layout = self.layout(sparse.values.buffer_view.value(), at, size, size, changed)?;
            let replaced: Vec<[f32; N]> = decode(&layout, component, accessor.normalized, changed);
            for (position, value) in replaced.into_iter().enumerate() {
                let target = whole_number(&indices, kind, position);
                let Some(slot) = values.get_mut(target) else {
                    return Err(format!("its sparse index {target} is beyond its {count} values"));
                };
                *slot = value;
            }
        }
        Ok(values)
    }

    /// Bytes of `count` elements in a view, checked to be there.
    fn layout(
        &self,
        view: usize,
        offset: u64,
        stride: usize,
        size: usize,
        count: usize,
    ) -> Result<Layout<'_>, String> {
        let bytes = self.view(view)?;
        if stride < size {
            return Err(format!("its elements of {size} bytes follow each other every {stride} bytes"));
        }
        let needed = match count.checked_sub(1) {
            Some(last) => (last as u64)
                .checked_mul(stride as u64)
                .and_then(|bytes| bytes.checked_add(size as u64))
                .and_then(|bytes| bytes.checked_add(offset)),
            None => Some(offset),
        };
        match needed {
            Some(needed) if needed <= bytes.len() as u64 => {
                Ok(Layout { bytes: &bytes[offset as usize..], stride })
            }
            _ => Err(format!(
                "{count} elements from byte {offset} on do not fit into the {} bytes of buffer view {view}; export the file again",
                bytes.len()
            )),
        }
    }
}

fn width(kind: Type) -> usize {
    match kind {
        Type::Scalar => 1,
        Type::Vec2 => 2,
        Type::Vec3 => 3,
        // Matrices of bytes have padding; nothing that is read here is a matrix.
        Type::Vec4 => 4,
        Type::Mat2 | Type::Mat3 | Type::Mat4 => 0,
    }
}

fn decode<const N: usize>(
    layout: &Layout<'_>,
    component: ComponentType,
    normalized: bool,
    count: usize,
) -> Vec<[f32; N]> {
    let full = |largest: f32| if normalized { largest } else { 1.0 };
    match component {
        ComponentType::F32 => gather(layout, count, f32::from_le_bytes),
        ComponentType::U32 => gather(layout, count, |b| u32::from_le_bytes(b) as f32),
        ComponentType::U8 => gather(layout, count, |[b]| f32::from(b) / full(255.0)),
        ComponentType::U16 => gather(layout, count, |b| f32::from(u16::from_le_bytes(b)) / full(65_535.0)),
        ComponentType::I8 => {
            gather(layout, count, |b| (f32::from(i8::from_le_bytes(b)) / full(127.0)).max(least(normalized)))
        }
        ComponentType::I16 => gather(layout, count, |b| {
            (f32::from(i16::from_le_bytes(b)) / full(32_767.0)).max(least(normalized))
        }),
    }
}

/// Signed integers have one value more below 0 than above; normalised, both ends are 1.
fn least(normalized: bool) -> f32 {
    if normalized { -1.0 } else { f32::NEG_INFINITY }
}

fn gather<const N: usize, const BYTES: usize>(
    layout: &Layout<'_>,
    count: usize,
    number: impl Fn([u8; BYTES]) -> f32,
) -> Vec<[f32; N]> {
    let element = |start: usize| {
        let bytes = &layout.bytes[start..start + N * BYTES];
        let (numbers, _) = bytes.as_chunks::<BYTES>();
        std::array::from_fn(|k| number(numbers[k]))
    };
    (0..count).map(|k| element(k * layout.stride)).collect()
}

fn whole_number(layout: &Layout<'_>, kind: ComponentType, position: usize) -> usize {
    let bytes = &layout.bytes[position * layout.stride..];
    match kind {
        ComponentType::U8 => usize::from(bytes[0]),
        ComponentType::U16 => usize::from(u16::from_le_bytes([bytes[0], bytes[1]])),
        _ => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as usize,
    }
}
