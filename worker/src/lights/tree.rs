//! Which light a shadow ray looks for: a tree of lights, descended by chance (Conty Estevez and Kulla 2018, "Importance
//! sampling of many lights with adaptive tree splitting"; the cone arithmetic as in pbrt-v4, section 12.6).
//!
//! Up to [`LEAF`] lights are weighed one by one. Above, each half counts as what it may give at most: its power, the
//! angles of its normals and the sphere round it.

use glam::Vec3;

use crate::scene::Spot;

/// Lights of a leaf, at most.
pub const LEAF: usize = 8;

/// Buckets a node's lights are sorted into, along each axis, to find where to divide them.
const BUCKETS: usize = 12;

/// Cosines count at least so much: near a lamp its middle says little.
const COSINE_MIN: f32 = 0.05;

/// Deeper, nodes are halved: a light's way down is no longer than its bits.
const DEPTH_MAX: u32 = 32;

/// Where light is looked for.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// World position.
    pub position: Vec3,
    /// Unit shading normal on the side that is lit.
    pub normal: Vec3,
}

/// A light as far as its choice goes.
#[derive(Clone, Copy, Debug)]
pub struct Lamp {
    /// Its middle.
    pub middle: Vec3,
    /// Its farthest point from there.
    pub radius: f32,
    /// W/sr on its axis, luminance.
    pub power: f32,
    /// Zero for a point.
    pub area: f32,
    /// How it shines.
    pub shines: Shines,
}

/// Which way a light shines.
#[derive(Clone, Copy, Debug)]
pub enum Shines {
    /// To one side, by the cosine with this unit normal.
    Front(Vec3),
    /// All round.
    Round,
    /// Into a cone.
    Cone(Spot),
}

impl Lamp {
    /// Roughly the irradiance it would give there, unhidden; 0 only if it gives none.
    fn share(&self, place: &Place) -> f32 {
        let offset = self.middle - place.position;
        let rise = place.normal.dot(offset);
        let distance2 = offset.length_squared();
        let distance = distance2.sqrt();
        let emission = match self.shines {
            Shines::Front(normal) => match -normal.dot(offset) {
                height if height > 0.0 => (height / distance).max(COSINE_MIN),
                _ => 0.0,
            },
            Shines::Round => 1.0,
            Shines::Cone(spot) => spot.falloff(-spot.axis.dot(offset / distance)),
        };
        // Some of it may rise above the horizon.
        let reception = if rise > -self.radius { (rise / distance).max(COSINE_MIN) } else { 0.0 };
        let share = self.power * emission * reception / (distance2 + self.area).max(f32::MIN_POSITIVE);
        // A point light at the very place is no number.
        if share > 0.0 { share.min(f32::MAX) } else { 0.0 }
    }

    /// Which way it shines; `None`: round about, or who knows.
    fn normal(&self) -> Option<Vec3> {
        match self.shines {
            Shines::Front(normal) => Some(normal),
            _ => None,
        }
    }
}

/// The tree.
pub struct LightTree {
    nodes: Vec<Node>,
    /// In the order of the leaves.
    lamps: Vec<Lamp>,
    /// For every lamp its leaf's way down: a bit for each level, the first lowest; 1 is the second child.
    ways: Vec<u32>,
}

#[derive(Clone, Copy, Default)]
struct Node {
    center: Vec3,
    radius: f32,
    /// Mean of the normals, and cosine and sine of the largest angle between it and one of them.
    axis: Vec3,
    spread: [f32; 2],
    power: f32,
    /// First lamp of a leaf; first of two children.
    first: u32,
    /// Lamps of a leaf; 0 for two children.
    count: u32,
}

impl LightTree {
    /// Builds the tree, and says for each of its lamps which of `lamps` it was.
    pub fn new(lamps: &[Lamp]) -> (Self, Vec<u32>) {
        let mut order: Vec<u32> = (0..lamps.len() as u32).collect();
        let mut tree = Self { nodes: vec![Node::default()], lamps: Vec::new(), ways: vec![0; lamps.len()] };
        let mut open = vec![(0, 0..lamps.len(), 0u32, 0u32)];
        while let Some((at, range, depth, way)) = open.pop() {
            let own = &mut order[range.clone()];
            let mut node = Node::around(lamps, own);
            if own.len() <= LEAF {
                (node.first, node.count) = (range.start as u32, own.len() as u32);
                tree.ways[range].fill(way);
            } else {
                let middle = range.start + divide(lamps, own, depth);
                node.first = tree.nodes.len() as u32;
                tree.nodes.resize(tree.nodes.len() + 2, Node::default());
                open.push((node.first as usize, range.start..middle, depth + 1, way));
                open.push((node.first as usize + 1, middle..range.end, depth + 1, way | 1 << depth));
            }
            tree.nodes[at] = node;
        }
        tree.lamps = order.iter().map(|&i| lamps[i as usize]).collect();
        (tree, order)
    }

    /// How many lamps it has.
    pub fn len(&self) -> usize {
        self.lamps.len()
    }

    /// Roughly the irradiance all lights would give a place, unhidden; 0 only if there is none.
    pub fn total(&self, place: &Place) -> f32 {
        if self.lamps.is_empty() {
            return 0.0;
        }
        self.weigh(&self.nodes[0], place, &mut [0.0; LEAF])
    }

    /// Chooses a lamp by `u` in [0, 1), and tells the chance it had; `None` when none shines there.
    pub fn choose(&self, place: &Place, mut u: f32) -> Option<(usize, f32)> {
        let mut node = &self.nodes[0];
        let mut chance = 1.0;
        let mut shares = [[0.0; LEAF]; 2];
        let mut total = self.weigh(node, place, &mut shares[0]);
        let mut side = 0;
        while node.count == 0 {
            let [first, second] = self.children(node);
            let [a, b] = &mut shares;
            let weights = [self.weigh(first, place, a), self.weigh(second, place, b)];
            let sum = weights[0] + weights[1];
            if sum <= 0.0 {
                return None;
            }
            let share = weights[0] / sum;
            side = usize::from(u >= share);
            // What is left of `u` serves for the next choice.
            u = if side == 0 { u / share } else { (u - share) / (1.0 - share) };
            (node, total) = ([first, second][side], weights[side]);
            chance *= total / sum;
        }
        let mut rest = u * total;
        let mut choice = None;
        for (i, &share) in shares[side].iter().enumerate().take(node.count as usize).filter(|(_, share)| **share > 0.0)
        {
            choice = Some((node.first as usize + i, chance * (share / total)));
            rest -= share;
            if rest < 0.0 {
                break;
            }
        }
        choice
    }

    /// The chance [`Self::choose`] gives a lamp.
    pub fn chance(&self, place: &Place, lamp: usize) -> f32 {
        let mut node = &self.nodes[0];
        let mut chance = 1.0;
        let mut shares = [[0.0; LEAF]; 2];
        let mut total = self.weigh(node, place, &mut shares[0]);
        let (mut way, mut side) = (self.ways[lamp], 0);
        while node.count == 0 {
            let [first, second] = self.children(node);
            let [a, b] = &mut shares;
            let weights = [self.weigh(first, place, a), self.weigh(second, place, b)];
            side = way as usize & 1;
            way >>= 1;
            if weights[side] <= 0.0 {
                return 0.0;
            }
            (node, total) = ([first, second][side], weights[side]);
            chance *= total / (weights[0] + weights[1]);
        }
        let share = shares[side][lamp - node.first as usize];
        if share > 0.0 { chance * (share / total) } else { 0.0 }
    }

    fn children(&self, node: &Node) -> [&Node; 2] {
        [&self.nodes[node.first as usize], &self.nodes[node.first as usize + 1]]
    }

    /// What a node may give a place; the shares of a leaf's lamps, whose sum it is, too.
    fn weigh(&self, node: &Node, place: &Place, shares: &mut [f32; LEAF]) -> f32 {
        if node.count == 0 {
            return node.share(place);
        }
        let first = node.first as usize;
        let lamps = &self.lamps[first..first + node.count as usize];
        let mut sum = 0.0;
        for (share, lamp) in shares.iter_mut().zip(lamps) {
            *share = lamp.share(place);
            sum += *share;
        }
        sum
    }
}

impl Node {
    /// What holds some of the lamps.
    fn around(lamps: &[Lamp], own: &[u32]) -> Self {
        let own = || own.iter().map(|&i| &lamps[i as usize]);
        let low = own().fold(Vec3::INFINITY, |low, lamp| low.min(lamp.middle - lamp.radius));
        let high = own().fold(Vec3::NEG_INFINITY, |high, lamp| high.max(lamp.middle + lamp.radius));
        let center = (low + high) * 0.5;
        let radius = own().map(|lamp| (lamp.middle - center).length() + lamp.radius).fold(0.0, f32::max);
        let axis = own().filter_map(|lamp| lamp.normal()).sum::<Vec3>().normalize_or(Vec3::Z);
        // A light that shines all round has its normal everywhere.
        let cosine = own().map(|lamp| lamp.normal().map_or(-1.0, |normal| normal.dot(axis))).fold(1.0, f32::min);
        let power = own().map(|lamp| f64::from(lamp.power)).sum::<f64>() as f32;
        Self { center, radius, axis, spread: [cosine, sine(cosine)], power, ..Self::default() }
    }

    /// About the most irradiance it gives a place; 0 only if it gives none.
    fn share(&self, place: &Place) -> f32 {
        let offset = self.center - place.position;
        let (distance2, radius2) = (offset.length_squared(), self.radius * self.radius);
        if distance2 <= radius2 {
            return self.power / radius2.max(f32::MIN_POSITIVE);
        }
        let distance = distance2.sqrt();
        // A little more than the sphere, so that rounding hides no light.
        let sine_out = (self.radius / distance * 1.001).min(1.0);
        let width = [sine(sine_out), sine_out];
        let towards = -self.axis.dot(offset) / distance;
        let [emission, _] = less(less([towards, sine(towards)], self.spread), width);
        let above = place.normal.dot(offset) / distance;
        let [reception, _] = less([above, sine(above)], width);
        if emission <= 0.0 || reception <= 0.0 {
            return 0.0;
        }
        self.power * emission.max(COSINE_MIN) * reception.max(COSINE_MIN) / distance2
    }
}

/// Cosine and sine of the difference of two angles given so; of none if it were below.
fn less([cosine, sine]: [f32; 2], [by_cosine, by_sine]: [f32; 2]) -> [f32; 2] {
    if cosine >= by_cosine {
        [1.0, 0.0]
    } else {
        [cosine * by_cosine + sine * by_sine, sine * by_cosine - cosine * by_sine]
    }
}

/// Sine of an angle in [0, π] by its cosine, or the other way round in [0, π/2].
fn sine(cosine: f32) -> f32 {
    (1.0 - cosine * cosine).max(0.0).sqrt()
}

/// Sorts lamps into two halves, and says how many the first has: the cheapest of several divisions, by power, extent and
/// how far normals spread; the median where none divides.
fn divide(lamps: &[Lamp], own: &mut [u32], depth: u32) -> usize {
    let middle = |i: u32| lamps[i as usize].middle;
    let low = own.iter().fold(Vec3::INFINITY, |low, &i| low.min(middle(i)));
    let high = own.iter().fold(Vec3::NEG_INFINITY, |high, &i| high.max(middle(i)));
    let extent = high - low;
    let bucket = |i: u32, axis: usize| {
        (((middle(i)[axis] - low[axis]) / extent[axis] * BUCKETS as f32) as usize).min(BUCKETS - 1)
    };
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in (0..3).filter(|&axis| extent[axis] > 0.0 && depth < DEPTH_MAX / 2) {
        let mut buckets = [Heap::EMPTY; BUCKETS];
        for &i in own.iter() {
            buckets[bucket(i, axis)].add(&Heap::of(&lamps[i as usize]));
        }
        let mut before = Heap::EMPTY;
        for last in 0..BUCKETS - 1 {
            before.add(&buckets[last]);
            let mut after = Heap::EMPTY;
            buckets[last + 1..].iter().for_each(|b| after.add(b));
            let cost = (before.cost() + after.cost()) * extent.max_element() / extent[axis];
            if before.count > 0 && after.count > 0 && best.is_none_or(|b| cost < b.0) {
                best = Some((cost, axis, last));
            }
        }
    }
    match best {
        Some((_, axis, last)) => {
            own.sort_by_key(|&i| (bucket(i, axis) > last, i));
            own.partition_point(|&i| bucket(i, axis) <= last)
        }
        None => {
            let axis = extent.max_position();
            own.sort_by(|&i, &j| middle(i)[axis].total_cmp(&middle(j)[axis]).then(i.cmp(&j)));
            own.len() / 2
        }
    }
}

/// What counts of several lamps when they are divided.
#[derive(Clone, Copy)]
struct Heap {
    count: u32,
    low: Vec3,
    high: Vec3,
    power: f32,
    /// Sum of normals times power; nothing from lights that shine all round.
    normals: Vec3,
}

impl Heap {
    const EMPTY: Self =
        Self { count: 0, low: Vec3::INFINITY, high: Vec3::NEG_INFINITY, power: 0.0, normals: Vec3::ZERO };

    fn of(lamp: &Lamp) -> Self {
        Self {
            count: 1,
            low: lamp.middle - lamp.radius,
            high: lamp.middle + lamp.radius,
            power: lamp.power,
            normals: lamp.normal().unwrap_or(Vec3::ZERO) * lamp.power,
        }
    }

    fn add(&mut self, other: &Self) {
        self.count += other.count;
        (self.low, self.high) = (self.low.min(other.low), self.high.max(other.high));
        self.power += other.power;
        self.normals += other.normals;
    }

    /// Power times area times the solid angle it shines into: from π, normals all alike, to 4 π.
    fn cost(&self) -> f32 {
        let [x, y, z] = (self.high - self.low).max(Vec3::ZERO).to_array();
        let spread = 1.0 - (self.normals.length() / self.power).min(1.0);
        self.power * (x * y + y * z + z * x) * (1.0 + 3.0 * spread)
    }
}
