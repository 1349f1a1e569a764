//! What pictures cost and how good they are, collected over several runs on one machine: a table, charts, and JSON to go on from.

use std::collections::BTreeMap;
use std::error::Error;
use std::fmt::Write as _;

use serde::{Deserialize, Serialize};

use crate::judge::Verdict;
use crate::report::{self, Curve};

/// Errors for which the table says what reaching them costs.
const WANTED: [f64; 3] = [0.05, 0.02, 0.01];

/// One picture.
#[derive(Clone, Serialize, Deserialize)]
pub struct Point {
    scene: String,
    /// Pixels in a row and column.
    edge: u32,
    renderer: String,
    setting: String,
    /// Seconds.
    cpu: f64,
    wall: f64,
    /// Relative to the reference's mean.
    rmse: f64,
    bias: f64,
    worst: f64,
    /// Processes that wanted a core, over the minute before it was done.
    load: String,
}

impl Point {
    /// A picture that was judged; `seconds`: CPU and wall.
    pub fn new(
        scene: String,
        edge: u32,
        renderer: String,
        setting: String,
        [cpu, wall]: [f64; 2],
        verdict: &Verdict,
    ) -> Self {
        let &Verdict { rmse, bias, worst, .. } = verdict;
        Self { scene, edge, renderer, setting, cpu, wall, rmse, bias, worst, load: report::load() }
    }

    fn row(&self) -> String {
        let Self { scene, edge, renderer, setting, cpu, wall, load, .. } = self;
        let [rmse, bias, worst] = [self.rmse, self.bias, self.worst].map(|v| 100.0 * v);
        format!(
            "| {scene} | {edge} | {renderer} | {setting} | {cpu:.2} | {wall:.2} | {rmse:.2} % | {bias:+.2} % | {worst:.2} % | {load} |"
        )
    }
}

/// All pictures of one machine.
#[derive(Serialize, Deserialize)]
pub struct Results {
    #[serde(skip)]
    name: String,
    machine: String,
    /// Of what rendered; `missing` where something was not installed.
    pub versions: BTreeMap<String, String>,
    commands: Vec<String>,
    points: Vec<Point>,
}

impl Results {
    /// What bench/results/NAME.json has, or nothing; the command of this run is added.
    ///
    /// # Errors
    /// A file of another machine, or none of ours.
    pub fn open(name: &str) -> Result<Self, Box<dyn Error>> {
        let (path, machine) = (report::file(&format!("{name}.json")), report::machine());
        let mut results: Self = match std::fs::read(&path) {
            Ok(bytes) => serde_json::from_slice(&bytes).map_err(|e| format!("{}: {e}", path.display()))?,
            Err(_) => Self {
                name: String::new(),
                machine: machine.clone(),
                versions: BTreeMap::new(),
                commands: vec![],
                points: vec![],
            },
        };
        if results.machine != machine {
            let (path, other) = (path.display(), results.machine);
            return Err(format!("{path} is of another machine ({other}; this one: {machine}): move it away").into());
        }
        results.name = name.into();
        let arguments: Vec<_> = std::env::args().skip(1).collect();
        let command = format!("cargo run --release -p ambience-bench -- {}", arguments.join(" "));
        if !results.commands.contains(&command) {
            results.commands.push(command);
        }
        Ok(results)
    }

    /// Adds a picture and prints it; one before of the same setting is forgotten.
    pub fn put(&mut self, point: Point) {
        println!("{}", point.row());
        let key = |p: &Point| (p.scene.clone(), p.edge, p.renderer.clone(), p.setting.clone());
        self.points.retain(|old| key(old) != key(&point));
        self.points.push(point);
    }

    /// Writes NAME.json, NAME.md and NAME.svg.
    ///
    /// # Errors
    /// The disk's.
    pub fn save(&mut self) -> Result<(), Box<dyn Error>> {
        let place = |p: &Point| (p.scene.clone(), p.edge, p.renderer.clone());
        self.points.sort_by(|a, b| place(a).cmp(&place(b)).then(a.cpu.total_cmp(&b.cpu)));
        let file = |ending: &str| report::file(&format!("{}.{ending}", self.name));
        std::fs::create_dir_all(report::file(""))?;
        std::fs::write(file("json"), serde_json::to_string_pretty(self)?)?;
        std::fs::write(file("md"), self.table())?;
        report::logarithmic(&self.name, "CPU seconds", report::SeriesLabelPosition::UpperRight, &self.panels())
    }

    /// The pictures of each scene and size, by renderer.
    fn groups(&self) -> BTreeMap<(&str, u32), BTreeMap<&str, Vec<&Point>>> {
        let mut groups: BTreeMap<_, BTreeMap<_, Vec<_>>> = BTreeMap::new();
        for p in &self.points {
            let group = groups.entry((p.scene.as_str(), p.edge)).or_default();
            group.entry(p.renderer.as_str()).or_default().push(p);
        }
        groups
    }

    fn table(&self) -> String {
        let mut text = format!("{}\n\n", self.machine);
        // A string does not fail.
        let mut line = |words: String| {
            let _ = writeln!(text, "{words}");
        };
        self.commands.iter().for_each(|command| line(format!("    {command}")));
        line(String::new());
        self.versions.iter().for_each(|(name, version)| line(format!("- {name}: {version}")));
        line("\nCPU seconds, all cores, to reach an error, between pictures on a straight line of logarithms; in brackets the \
              worst block there.\n"
            .into());
        line(format!("| scene | edge | renderer |{} |", WANTED.map(|e| format!(" {} %", 100.0 * e)).join(" |")));
        line("|---|---|---|---|---|---|".into());
        for ((scene, edge), renderers) in self.groups() {
            for (renderer, points) in renderers {
                let cells = WANTED.map(|error| match reach(&points, error) {
                    Some((cpu, worst)) => format!(" {cpu:.1} s ({:.1} %)", 100.0 * worst),
                    None => " -".into(),
                });
                line(format!("| {scene} | {edge} | {renderer} |{} |", cells.join(" |")));
            }
        }
        line("\n| scene | edge | renderer | setting | CPU s | wall s | RMSE | bias | worst block | load |".into());
        line("|---|---|---|---|---|---|---|---|---|---|".into());
        self.points.iter().for_each(|p| line(p.row()));
        text
    }

    fn panels(&self) -> Vec<(String, Vec<Curve>)> {
        let mut panels = Vec::new();
        for ((scene, edge), renderers) in self.groups() {
            for (what, value) in [("RMSE", (|p| p.rmse) as fn(&Point) -> f64), ("worst block", |p| p.worst)] {
                let curves = renderers.iter().map(|(renderer, points)| {
                    ((*renderer).into(), points.iter().map(|p| (p.cpu, 100.0 * value(p).max(1e-5))).collect())
                });
                panels.push((format!("{scene}, {edge} x {edge}: {what}, %"), curves.collect()));
            }
        }
        panels
    }
}

/// CPU seconds at which a curve first comes down to an error, and the worst block there; `points` by CPU seconds. `None`: it does
/// not, or its cheapest picture is better already.
fn reach(points: &[&Point], error: f64) -> Option<(f64, f64)> {
    points.windows(2).find(|ends| ends[0].rmse > error && ends[1].rmse <= error).map(|ends| {
        let t = (ends[0].rmse / error).ln() / (ends[0].rmse / ends[1].rmse.max(1e-9)).ln();
        let between = |value: fn(&Point) -> f64| value(ends[0]) * (value(ends[1]) / value(ends[0])).powf(t);
        (between(|p| p.cpu), between(|p| p.worst.max(1e-9)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(cpu: f64, rmse: f64) -> Point {
        let verdict = Verdict { rmse, bias: 0.0, worst: 2.0 * rmse, place: Default::default() };
        Point::new("s".into(), 128, "r".into(), format!("{cpu}"), [cpu, cpu], &verdict)
    }

    #[test]
    fn an_error_is_reached_between_pictures() {
        // Four times the work halves the error: 2 % lies at 4 s, 1 % at 16 s.
        let points = [point(1.0, 0.04), point(16.0, 0.01)];
        let points: Vec<_> = points.iter().collect();
        let (cpu, worst) = reach(&points, 0.02).expect("between them");
        assert!((cpu - 4.0).abs() < 1e-9 && (worst - 0.04).abs() < 1e-9, "{cpu} {worst}");
        assert!(reach(&points, 0.05).is_none() && reach(&points, 0.005).is_none());
    }

    #[test]
    fn a_setting_made_again_replaces_what_was() {
        let mut results = Results {
            name: String::new(),
            machine: String::new(),
            versions: BTreeMap::new(),
            commands: vec![],
            points: vec![],
        };
        results.put(point(1.0, 0.04));
        results.put(point(2.0, 0.03));
        results.put(point(1.0, 0.02));
        let kept: Vec<_> = results.points.iter().map(|p| (p.cpu, p.rmse)).collect();
        assert_eq!(kept, [(2.0, 0.03), (1.0, 0.02)]);
    }
}
