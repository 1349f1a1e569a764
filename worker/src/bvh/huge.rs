//! Memory in huge pages where the system gives them: a tree is read all over, and most of its pages would not be in the TLB.

use std::marker::PhantomData;
use std::ops::Deref;

use bytemuck::Pod;
use memmap2::MmapMut;

/// A slice that never changes.
pub struct Huge<T> {
    memory: MmapMut,
    of: PhantomData<T>,
}

impl<T: Pod> Huge<T> {
    /// Copies a slice.
    ///
    /// # Panics
    /// When there is not so much memory.
    pub fn new(from: &[T]) -> Self {
        let mut memory = MmapMut::map_anon(size_of_val(from).max(1)).expect("memory for the tree");
        // Only a hint: small pages are right, too.
        #[cfg(target_os = "linux")]
        let _ = memory.advise(memmap2::Advice::HugePage);
        memory[..size_of_val(from)].copy_from_slice(bytemuck::cast_slice(from));
        Self { memory, of: PhantomData }
    }
}

impl<T: Pod> Deref for Huge<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        let whole = self.memory.len() / size_of::<T>() * size_of::<T>();
        bytemuck::cast_slice(&self.memory[..whole])
    }
}
