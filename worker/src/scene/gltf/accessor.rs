//! Typed, bounds-checked reading of accessors. What a count claims is believed only as far as there are bytes, so nothing
//! here allocates more than a few times the file's size.

use ::gltf::json::accessor::{Accessor, ComponentType, Type};
use ::gltf::json::validation::Checked;
use ::gltf::json::{Index, buffer};

use super::Fault;
use super::container::{Document, beyond, slice};

/// The bytes of an accessor, element by element.
pub(super) struct Elements<'a> {
    bytes: &'a [u8],
    stride: usize,
    /// Bytes of one element.
    size: usize,
    count: usize,
    component: ComponentType,
    normalized: bool,
}

impl Document {
    /// The accessor's elements, which must be of type `expected`.
    pub(super) fn elements(&self, index: Index<Accessor>, expected: Type) -> Result<Elements<'_>, Fault> {
        self.elements_unnamed(index, expected).map_err(|fault| format!("accessor {index}: {fault}"))
    }

    fn elements_unnamed(&self, index: Index<Accessor>, expected: Type) -> Result<Elements<'_>, Fault> {
        let accessor = self.root.get(index).ok_or_else(|| beyond(self.root.accessors.len()))?;
        if accessor.sparse.is_some() {
            return Err("sparse accessors are not supported; store all elements".into());
        }
        let view_index = accessor.buffer_view.ok_or("has no bufferView; expected one")?;
        let Checked::Valid(component) = accessor.component_type else {
            return Err("unknown componentType; expected 5120 to 5126".into());
        };
        match accessor.type_ {
            Checked::Valid(found) if found == expected => {}
            Checked::Valid(found) => return Err(format!("type is {found:?}; expected {expected:?}")),
            Checked::Invalid => return Err(format!("unknown type; expected {expected:?}")),
        }
        let bytes = self.view(view_index)?;
        let size = component.0.size() * expected.multiplicity();
        let stride = self.stride(view_index).unwrap_or(size);
        if stride < size {
            return Err(format!(
                "bufferView {view_index}: byteStride {stride} is below the {size} bytes of an element"
            ));
        }
        let (start, count) = (accessor.byte_offset.unwrap_or_default().0, accessor.count.0);
        let bytes = spanned(bytes, start, count, stride, size).ok_or_else(|| {
            format!(
                "{count} elements of {size} bytes, {stride} apart, from byteOffset {start} reach beyond bufferView \
                 {view_index}, which has {} bytes",
                bytes.len()
            )
        })?;
        // The span check has bounded the count by the number of bytes.
        let count = count as usize;
        Ok(Elements { bytes, stride, size, count, component: component.0, normalized: accessor.normalized })
    }

    fn stride(&self, view: Index<buffer::View>) -> Option<usize> {
        Some(self.root.get(view)?.byte_stride?.0)
    }
}

/// The bytes that `count` elements take.
fn spanned(bytes: &[u8], start: u64, count: u64, stride: usize, size: usize) -> Option<&[u8]> {
    let length = match count.checked_sub(1) {
        None => 0,
        Some(before_last) => before_last.checked_mul(stride as u64)?.checked_add(size as u64)?,
    };
    slice(bytes, start, length)
}

impl Elements<'_> {
    /// The elements as `N` numbers each, integers as the format (and KHR_mesh_quantization) says.
    pub(super) fn floats<const N: usize>(&self) -> Result<Vec<[f32; N]>, Fault> {
        let read: fn(&[u8], bool) -> f32 = match self.component {
            ComponentType::F32 => |b, _| f32::from_le_bytes(array(b)),
            ComponentType::I8 => |b, n| scaled(f32::from(i8::from_le_bytes(array(b))), n, 127.0),
            ComponentType::U8 => |b, n| scaled(f32::from(u8::from_le_bytes(array(b))), n, 255.0),
            ComponentType::I16 => |b, n| scaled(f32::from(i16::from_le_bytes(array(b))), n, 32767.0),
            ComponentType::U16 => |b, n| scaled(f32::from(u16::from_le_bytes(array(b))), n, 65535.0),
            ComponentType::U32 => {
                return Err("componentType is unsigned int; expected float or a shorter integer".into());
            }
        };
        let component = self.component.size();
        let element =
            |bytes: &[u8]| std::array::from_fn(|i| read(bytes.get(i * component..).unwrap_or(&[]), self.normalized));
        Ok(self.raw().map(element).collect())
    }

    /// The elements as vertex numbers.
    pub(super) fn indices(&self) -> Result<Vec<u32>, Fault> {
        let read: fn(&[u8]) -> u32 = match self.component {
            ComponentType::U8 => |b| u32::from(u8::from_le_bytes(array(b))),
            ComponentType::U16 => |b| u32::from(u16::from_le_bytes(array(b))),
            ComponentType::U32 => |b| u32::from_le_bytes(array(b)),
            _ => return Err("componentType of indices is not an unsigned integer".into()),
        };
        Ok(self.raw().map(read).collect())
    }

    fn raw(&self) -> impl Iterator<Item = &[u8]> {
        (0..self.count).map(|i| self.bytes.get(i * self.stride..i * self.stride + self.size).unwrap_or(&[]))
    }
}

/// The first bytes as an array. Bounds are checked before; zeros where bytes were missing all the same.
fn array<const N: usize>(bytes: &[u8]) -> [u8; N] {
    bytes.first_chunk().copied().unwrap_or([0; N])
}

fn scaled(value: f32, normalized: bool, largest: f32) -> f32 {
    if normalized { (value / largest).max(-1.0) } else { value }
}
