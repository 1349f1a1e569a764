//! The `!xform` command, worked out here: no program is ever started.
//!
//! Arguments and their meaning are those of Radiance's `xform`: transforms apply from left to right, `-i n` repeats
//! those that follow it n times, `-a n` makes n copies in which they are repeated 0, 1, ... n-1 times.

use glam::{DAffine3, DMat3, DVec3};

use super::lexer::{finite, is_space, show};

/// Most copies that one command may make.
const MAX_COPIES: u64 = 1_000_000;

/// How an included file's content becomes part of the scene. The outermost file has the default.
#[derive(Clone, Debug, Default)]
pub(super) struct Frame {
    /// Takes the file's coordinates to world coordinates.
    pub(super) step: Step,
    /// Whether surfaces are turned inside out (`-I`).
    pub(super) inverted: bool,
    /// Replaces the modifier of every surface (`-m`).
    pub(super) modifier: Option<Vec<u8>>,
    /// Put before the names of surfaces (`-n`), its dot included.
    pub(super) prefix: String,
}

impl Frame {
    /// The frame of a file that is included with `inner` from a file that has this frame.
    pub(super) fn around(&self, inner: &Frame) -> Frame {
        Frame {
            step: inner.step.then(&self.step),
            inverted: self.inverted != inner.inverted,
            modifier: self.modifier.clone().or_else(|| inner.modifier.clone()),
            prefix: format!("{}{}", self.prefix, inner.prefix),
        }
    }

    /// Takes a point to world coordinates.
    pub(super) fn point(&self, p: DVec3) -> DVec3 {
        self.step.affine.transform_point3(p)
    }

    /// Takes a direction to world coordinates; its length is scaled.
    pub(super) fn vector(&self, v: DVec3) -> DVec3 {
        self.step.affine.transform_vector3(v)
    }

    /// Takes a length to world lengths.
    pub(super) fn length(&self, l: f64) -> f64 {
        l * self.step.factor.abs()
    }

    /// Whether a polygon's outline must be reversed to keep its front in front: a mirror image turns round.
    pub(super) fn reverses(&self) -> bool {
        (self.step.factor < 0.0) != self.inverted
    }
}

/// A similarity: the matrix, and the factor by which it scales lengths, negative when it mirrors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// The matrix.
    pub(super) affine: DAffine3,
    /// The factor.
    pub(super) factor: f64,
}

impl Default for Step {
    fn default() -> Self {
        Self { affine: DAffine3::IDENTITY, factor: 1.0 }
    }
}

impl Step {
    fn then(&self, next: &Step) -> Step {
        Step { affine: next.affine * self.affine, factor: next.factor * self.factor }
    }

    fn translate(by: DVec3) -> Step {
        Step { affine: DAffine3::from_translation(by), factor: 1.0 }
    }

    /// Scales the axes, all by the same absolute value; `factor` has the sign of the determinant.
    fn scale(axes: DVec3, factor: f64) -> Step {
        Step { affine: DAffine3::from_scale(axes), factor }
    }

    /// Turns by `degrees` about a coordinate axis, counter-clockwise when it points at the viewer.
    fn rotate(axis: usize, degrees: f64) -> Step {
        let (sin, cos) = libm::sincos(degrees.to_radians());
        let mut columns = [DVec3::X, DVec3::Y, DVec3::Z];
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        columns[i][i] = cos;
        columns[i][j] = sin;
        columns[j][i] = -sin;
        columns[j][j] = cos;
        Step { affine: DAffine3::from_mat3(DMat3::from_cols(columns[0], columns[1], columns[2])), factor: 1.0 }
    }

    /// This step `times` times; by squaring, since a file may say a billion.
    fn repeated(&self, mut times: u64) -> Step {
        let (mut power, mut total) = (*self, Step::default());
        while times > 0 {
            if times & 1 == 1 {
                total = total.then(&power);
            }
            power = power.then(&power);
            times >>= 1;
        }
        total
    }
}

/// One argument that makes up the transform.
#[derive(Clone, Copy, Debug)]
enum Op {
    Move(Step),
    Repeat(u64),
    Array(u64),
}

/// A command line taken apart.
#[derive(Debug, Default)]
pub(super) struct Xform {
    /// What is transformed, at least one.
    pub(super) files: Vec<Vec<u8>>,
    ops: Vec<Op>,
    inverted: bool,
    modifier: Option<Vec<u8>>,
    prefix: String,
}

impl Xform {
    /// Takes apart the arguments that follow the program's name.
    ///
    /// # Errors
    /// What is wrong with which argument.
    pub(super) fn parse(args: &[Vec<u8>]) -> Result<Xform, String> {
        let mut xform = Xform::default();
        let mut rest = Args { args, at: 0 };
        while let Some(option) = rest.option() {
            xform.option(option, &mut rest)?;
        }
        xform.files = args[rest.at..].to_vec();
        if xform.files.is_empty() {
            return Err("xform has no file to read; expected a file name after its options".into());
        }
        if xform.copies().is_none_or(|n| n > MAX_COPIES) {
            return Err(format!("xform -a makes too many copies; the most is {MAX_COPIES}"));
        }
        Ok(xform)
    }

    fn option(&mut self, option: &[u8], rest: &mut Args) -> Result<(), String> {
        match option {
            b"-t" => self.ops.push(Op::Move(Step::translate(DVec3::new(rest.real()?, rest.real()?, rest.real()?)))),
            b"-rx" => self.ops.push(Op::Move(Step::rotate(0, rest.real()?))),
            b"-ry" => self.ops.push(Op::Move(Step::rotate(1, rest.real()?))),
            b"-rz" => self.ops.push(Op::Move(Step::rotate(2, rest.real()?))),
            b"-mx" => self.ops.push(Op::Move(Step::scale(DVec3::new(-1.0, 1.0, 1.0), -1.0))),
            b"-my" => self.ops.push(Op::Move(Step::scale(DVec3::new(1.0, -1.0, 1.0), -1.0))),
            b"-mz" => self.ops.push(Op::Move(Step::scale(DVec3::new(1.0, 1.0, -1.0), -1.0))),
            b"-s" => {
                let factor = rest.real()?;
                if factor == 0.0 {
                    return Err("xform -s 0 leaves nothing; expected a factor other than 0".into());
                }
                self.ops.push(Op::Move(Step::scale(DVec3::splat(factor), factor)));
            }
            b"-i" => self.ops.push(Op::Repeat(rest.count(0)?)),
            b"-a" => self.ops.push(Op::Array(rest.count(1)?)),
            b"-I" => self.inverted = !self.inverted,
            b"-m" => {
                let name = rest.name()?;
                // As xform does: of several, the first counts.
                self.modifier.get_or_insert_with(|| name.to_vec());
            }
            b"-n" => self.prefix += &format!("{}.", show(rest.name()?)),
            // Whether nested commands are run now or by the next reader makes no difference: they are run.
            b"-e" | b"-c" => {}
            _ => {
                return Err(format!(
                    "xform option `{}` is not supported; expected -t -rx -ry -rz -s -mx -my -mz -i -a -m -n -I -e -c -f",
                    show(option)
                ));
            }
        }
        Ok(())
    }

    /// How many copies the command makes; `None` for more than can be counted.
    fn copies(&self) -> Option<u64> {
        self.arrays().try_fold(1u64, |product, n| product.checked_mul(n))
    }

    fn arrays(&self) -> impl DoubleEndedIterator<Item = u64> {
        self.ops.iter().filter_map(|op| if let Op::Array(n) = op { Some(*n) } else { None })
    }

    /// The frames of all copies, in xform's order: the last array runs fastest.
    pub(super) fn frames(&self) -> impl Iterator<Item = Frame> {
        (0..self.copies().unwrap_or(0)).map(|copy| self.frame(copy))
    }

    fn frame(&self, copy: u64) -> Frame {
        let mut digits: Vec<u64> = Vec::new();
        let mut left = copy;
        for size in self.arrays().rev() {
            digits.push(left % size);
            left /= size;
        }
        let (mut total, mut pending, mut times) = (Step::default(), Step::default(), 1);
        for op in &self.ops {
            let next = match op {
                Op::Move(step) => {
                    pending = pending.then(step);
                    continue;
                }
                Op::Repeat(n) => *n,
                Op::Array(_) => digits.pop().unwrap_or(0),
            };
            total = total.then(&pending.repeated(times));
            (pending, times) = (Step::default(), next);
        }
        Frame {
            step: total.then(&pending.repeated(times)),
            inverted: self.inverted,
            modifier: self.modifier.clone(),
            prefix: self.prefix.clone(),
        }
    }
}

/// Arguments and how many of them are used up.
struct Args<'a> {
    args: &'a [Vec<u8>],
    at: usize,
}

impl<'a> Args<'a> {
    fn option(&mut self) -> Option<&'a [u8]> {
        let option = self.args.get(self.at).filter(|a| a.first() == Some(&b'-'))?;
        self.at += 1;
        Some(option)
    }

    fn name(&mut self) -> Result<&'a [u8], String> {
        let after = show(&self.args[self.at - 1]);
        let name =
            self.args.get(self.at).ok_or_else(|| format!("xform {after} ends the line; expected its argument"))?;
        self.at += 1;
        Ok(name)
    }

    fn real(&mut self) -> Result<f64, String> {
        let name = self.name()?;
        finite(name).ok_or_else(|| format!("xform argument `{}`: expected a finite number", show(name)))
    }

    fn count(&mut self, least: u64) -> Result<u64, String> {
        let name = self.name()?;
        let count = std::str::from_utf8(name).ok().and_then(|text| text.parse().ok());
        count
            .filter(|&n| n >= least)
            .ok_or_else(|| format!("xform argument `{}`: expected a whole number >= {least}", show(name)))
    }
}

/// Parts a command line into words as a shell would, quotes and backslashes included.
///
/// # Errors
/// Anything that only a shell could do: pipes, redirection, variables, patterns.
pub(super) fn words(line: &[u8]) -> Result<Vec<Vec<u8>>, String> {
    let mut words = Vec::new();
    let mut word: Option<Vec<u8>> = None;
    let mut quote = None;
    let mut bytes = line.iter().copied();
    while let Some(byte) = bytes.next() {
        match (quote, byte) {
            (Some(q), b) if b == q => quote = None,
            (None, b'"' | b'\'') => {
                quote = Some(byte);
                word.get_or_insert_default();
            }
            (Some(b'"') | None, b'\\') => word.get_or_insert_default().extend(bytes.next()),
            (Some(b'"'), b'$' | b'`') | (None, b'|' | b'&' | b';' | b'<' | b'>' | b'(' | b')' | b'$' | b'`') => {
                return Err(format!("`{}` needs a shell; expected a single xform command", byte as char));
            }
            (None, b'*' | b'?' | b'[' | b'~') => {
                return Err(format!("`{}` needs a shell; expected file names written out", byte as char));
            }
            (None, b) if is_space(b) => words.extend(word.take()),
            (_, b) => word.get_or_insert_default().push(b),
        }
    }
    if quote.is_some() {
        return Err("a quote is not closed; expected its end on the line".into());
    }
    words.extend(word);
    Ok(words)
}
