//! Tables and charts.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::Command;

pub use plotters::chart::SeriesLabelPosition;
use plotters::coord::Shift;
use plotters::coord::ranged1d::{AsRangedCoord, Ranged, ValueFormatter};
use plotters::prelude::*;

/// Where results are kept, in the repository.
pub fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("results").join(name)
}

/// Compiler, system, cores and processor.
pub fn machine() -> String {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = cpu.lines().find_map(|l| l.strip_prefix("model name")?.split_once(": "));
    let rustc = Command::new("rustc").arg("-V").output().map(|out| String::from_utf8_lossy(&out.stdout).into_owned());
    format!(
        "{}, {}, {} cores of {}",
        rustc.as_deref().unwrap_or("rustc ?").trim(),
        std::env::consts::OS,
        worker::farm::cores(),
        model.map_or("an unknown processor", |(_, name)| name),
    )
}

/// Processes that wanted a core, over the last minute.
pub fn load() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    load.split(' ').next().unwrap_or("unknown").into()
}

/// Lines that are printed and, if asked for, kept.
#[derive(Default)]
pub struct Report(String);

impl Report {
    /// A report that begins with where, when nobody else was at work or not, and by which command it was made.
    pub fn begin(command: &str) -> Self {
        let mut report = Self::default();
        report.line(&format!("$ {command}"));
        report.line(&format!("ambience {}, {}, load before {}", env!("CARGO_PKG_VERSION"), machine(), load()));
        report
    }

    /// Adds a line.
    pub fn line(&mut self, line: &str) {
        println!("{line}");
        self.0.push_str(line);
        self.0.push('\n');
    }

    /// Writes bench/results/NAME.txt.
    ///
    /// # Errors
    /// The disk's.
    pub fn save(&self, name: &str) -> std::io::Result<()> {
        std::fs::create_dir_all(file(""))?;
        std::fs::write(file(&format!("{name}.txt")), &self.0)
    }
}

/// One number in the middle, and the p99 with it.
pub fn quantile(values: &mut [f64], q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let last = values.len().saturating_sub(1);
    values.get((last as f64 * q).round() as usize).copied().unwrap_or(f64::NAN)
}

/// Draws bars with their names, and a line at `target`, to bench/results/NAME.svg.
///
/// # Errors
/// The disk's.
pub fn bars(name: &str, title: &str, bars: &[(String, f64)], target: f64) -> Result<(), Box<dyn Error>> {
    let path = file(&format!("{name}.svg"));
    let root = SVGBackend::new(&path, (860, 60 + 34 * bars.len() as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    let most = bars.iter().map(|bar| bar.1).fold(1.0, f64::max) * 1.1;
    let mut chart = ChartBuilder::on(&root)
        .caption(title, ("sans-serif", 16))
        .margin(10)
        .set_label_area_size(LabelAreaPosition::Left, 330)
        .set_label_area_size(LabelAreaPosition::Bottom, 24)
        .build_cartesian_2d(0.0..most, 0.0..bars.len() as f64)?;
    chart.configure_mesh().disable_y_mesh().y_labels(0).draw()?;
    for (row, (name, value)) in bars.iter().rev().enumerate() {
        let (low, middle) = (row as f64, row as f64 + 0.5);
        chart.draw_series([Rectangle::new(
            [(0.0, low + 0.15), (*value, low + 0.85)],
            RGBColor(70, 110, 160).filled(),
        )])?;
        chart
            .draw_series([EmptyElement::at((0.0, middle))
                + Text::new(format!("{name}  {value:.2}"), (-325, -7), ("sans-serif", 14))])?;
    }
    chart.draw_series(LineSeries::new([(target, 0.0), (target, bars.len() as f64)], RED))?;
    Ok(root.present()?)
}

/// One curve: its name and its points.
pub type Curve = (String, Vec<(f64, f64)>);

/// Draws panels beside each other, each of curves over the number of workers on a logarithmic axis, to
/// bench/results/NAME.svg.
///
/// # Errors
/// The disk's.
pub fn curves(name: &str, panels: &[(&str, Vec<Curve>)]) -> Result<(), Box<dyn Error>> {
    beside(name, panels, |area, title, curves| {
        let [(_, right), (_, top)] = extent(curves);
        let (x, y) = ((0.9..right * 1.2).log_scale(), 0.0..top * 1.1);
        panel(area, title, "workers", x, y, curves, SeriesLabelPosition::MiddleRight)
    })
}

/// Draws panels beside each other, each of curves over what is named `below`, both axes logarithmic, to
/// bench/results/NAME.svg.
///
/// # Errors
/// The disk's.
pub fn logarithmic(
    name: &str,
    below: &str,
    legend: SeriesLabelPosition,
    panels: &[(String, Vec<Curve>)],
) -> Result<(), Box<dyn Error>> {
    beside(name, panels, |area, title, curves| {
        let [x, y] = extent(curves).map(|(low, high)| (low / 1.5..high * 1.5).log_scale());
        panel(area, title, below, x, y, curves, legend.clone())
    })
}

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

fn beside<T: AsRef<str>>(
    name: &str,
    panels: &[(T, Vec<Curve>)],
    draw: impl Fn(&Area, &str, &[Curve]) -> Result<(), Box<dyn Error>>,
) -> Result<(), Box<dyn Error>> {
    let path = file(&format!("{name}.svg"));
    let columns = 2;
    let rows = panels.len().div_ceil(columns);
    let root = SVGBackend::new(&path, (980, 330 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    for ((title, curves), area) in panels.iter().zip(root.split_evenly((rows, columns))) {
        draw(&area, title.as_ref(), curves)?;
    }
    Ok(root.present()?)
}

/// Least and greatest x, and y.
fn extent(curves: &[Curve]) -> [(f64, f64); 2] {
    let points = || curves.iter().flat_map(|(_, points)| points);
    [|p: &(f64, f64)| p.0, |p: &(f64, f64)| p.1].map(|pick| {
        let high = points().map(pick).fold(1e-9, f64::max);
        (points().map(pick).fold(high, f64::min), high)
    })
}

fn panel<X, Y>(
    area: &Area,
    title: &str,
    below: &str,
    x: X,
    y: Y,
    curves: &[Curve],
    legend: SeriesLabelPosition,
) -> Result<(), Box<dyn Error>>
where
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
    Y::CoordDescType: Ranged<ValueType = f64> + ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(12)
        .set_label_area_size(LabelAreaPosition::Left, 60)
        .set_label_area_size(LabelAreaPosition::Bottom, 36)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_desc(below)
        .x_labels(12)
        .x_label_formatter(&|x| ((x * 1e4).round() / 1e4).to_string())
        .draw()?;
    for (at, (label, points)) in curves.iter().enumerate() {
        let color = Palette99::pick(at).to_rgba();
        chart
            .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?
            .label(label)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
        chart.draw_series(points.iter().map(|&point| Circle::new(point, 3, color.filled())))?;
    }
    chart
        .configure_series_labels()
        .position(legend)
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK.mix(0.3))
        .draw()?;
    Ok(())
}
