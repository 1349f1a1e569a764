//! How long each tile of a frame will take, by how long it took in the steps before. No I/O.
//!
//! What is gathered lies where edges, corners and shadows are: a step's first tiles say little of its others, the same
//! tile in the step before says much.

use std::ops::Range;
use std::time::Duration;

/// How much of what a tile took counts against what it took before.
const NEWEST: f32 = 0.5;

/// What a tile is thought to take at least, as a fraction of the mean: holes open where none were.
const LEAST: f32 = 0.25;

/// Seconds of work, tile by tile.
#[derive(Clone, PartialEq, Debug)]
pub struct Expected {
    /// Of each tile what it took, the newest first in weight; NaN where nothing is known.
    took: Vec<f32>,
    /// Level of the step it is told of; another level is other work.
    level: u32,
}

impl Expected {
    /// Nothing is known of so many tiles.
    pub fn nothing(tiles: u32) -> Self {
        Self { took: vec![f32::NAN; tiles as usize], level: 0 }
    }

    /// What is expected of a step of `level`, in seconds for each tile; 1 for each where nothing is known of any, and then
    /// `false`.
    pub fn of(&mut self, level: u32) -> (Vec<f32>, bool) {
        if std::mem::replace(&mut self.level, level) != level {
            self.took.fill(f32::NAN);
        }
        let known = || self.took.iter().filter(|took| !took.is_nan());
        let mean = known().map(|took| f64::from(*took)).sum::<f64>() / known().count() as f64;
        if mean.is_nan() || mean <= 0.0 {
            return (vec![1.0; self.took.len()], false);
        }
        let mean = mean as f32;
        let expected = |took: &f32| if took.is_nan() { mean } else { took.max(LEAST * mean) };
        (self.took.iter().map(expected).collect(), true)
    }

    /// Takes note of how long some tiles took together; of those that had nothing to do it says nothing.
    pub fn took(&mut self, tiles: Range<u32>, idle: impl Fn(u32) -> bool, together: Duration) {
        let busy = || tiles.clone().filter(|tile| !idle(*tile));
        let each = together.as_secs_f32() / busy().count() as f32;
        for tile in busy() {
            let took = &mut self.took[tile as usize];
            *took = if took.is_nan() { each } else { *took + NEWEST * (each - *took) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_tile_took_is_expected_of_it_and_no_longer_on_another_level() {
        let mut expected = Expected::nothing(4);
        assert_eq!(expected.of(2), (vec![1.0; 4], false));
        expected.took(0..1, |_| false, Duration::from_secs(3));
        // Tile 2 had nothing to do.
        expected.took(1..3, |tile| tile == 2, Duration::from_secs(1));
        assert_eq!(expected.of(2), (vec![3.0, 1.0, 2.0, 2.0], true));
        expected.took(0..1, |_| false, Duration::ZERO);
        assert_eq!(expected.of(2).0[0], 1.5);
        for _ in 0..9 {
            expected.took(1..2, |_| false, Duration::ZERO);
        }
        let (seconds, _) = expected.of(2);
        assert!(seconds[1] == LEAST * seconds[2], "{seconds:?}");
        assert_eq!(expected.of(1), (vec![1.0; 4], false));
    }
}
