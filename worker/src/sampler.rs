//! Where a path's random numbers come from: well-spread points for the samples of a pixel, an id's own stream for gathers.

use cache_core::id::Random;

/// Gives four numbers in [0, 1) at a time.
pub enum Sampler {
    /// Owen-scrambled Sobol points: sample `index` of the pixel with this `seed`.
    Pixel {
        /// Which sample, 0 to 65535.
        index: u32,
        /// Scrambles the points; different for every pixel.
        seed: u32,
        /// Next set of four dimensions.
        set: u32,
    },
    /// Numbers that belong to a name or a record.
    Stream(Random),
}

/// Sets of four dimensions the Sobol points have.
const SETS: u32 = 64;

impl Sampler {
    /// Sample `index` of a pixel.
    pub fn pixel(index: u32, seed: u32) -> Self {
        Self::Pixel { index, seed, set: 0 }
    }

    /// Independent numbers for a side task; this sampler goes on as if there had been none but four numbers.
    pub fn branch(&mut self) -> Self {
        Self::Stream(Random::named("branch", &self.next4().map(|x| x.to_bits().into())))
    }

    /// The next four numbers.
    pub fn next4(&mut self) -> [f32; 4] {
        match self {
            Self::Pixel { index, seed, set } if *set < SETS => {
                *set += 1;
                sobol_burley::sample_4d(*index, *set - 1, *seed)
            }
            Self::Pixel { index, seed, .. } => {
                let mut random = Random::named("long path", &[u64::from(*index), u64::from(*seed)]);
                let four = std::array::from_fn(|_| random.uniform());
                *self = Self::Stream(random);
                four
            }
            Self::Stream(random) => std::array::from_fn(|_| random.uniform()),
        }
    }
}
