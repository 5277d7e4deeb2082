//! Plots as SVG, drawn by plotters.

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, ValueFormatter};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;

/// Distinct on white, and apart for most kinds of colour vision (Okabe and Ito).
const COLORS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(120, 120, 120),
    RGBColor(0, 0, 0),
];

const INK: RGBColor = RGBColor(40, 44, 52);
const GRID: RGBColor = RGBColor(228, 230, 234);

/// Points of one colour.
pub(crate) struct Series {
    /// In the legend.
    pub name: String,
    /// Places, with what they are called where that helps.
    pub points: Vec<(f64, f64, String)>,
    /// Joined by a line.
    pub line: bool,
}

/// A plot.
pub(crate) struct Plot<'a> {
    /// Axis captions with units.
    pub axes: [&'a str; 2],
    /// Horizontal axis in powers of ten.
    pub log: bool,
    /// Series.
    pub series: Vec<Series>,
    /// Places of the front, joined by a dashed line.
    pub front: Vec<(f64, f64)>,
    /// Width and height, pixels.
    pub size: (u32, u32),
}

/// A decimal axis that may stand for powers of ten, with labels of few digits.
struct Axis {
    inner: RangedCoordf64,
    log: bool,
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        self.inner.map(value, limit)
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if !self.log {
            return self.inner.key_points(hint);
        }
        let range = self.inner.range();
        let whole = (range.start.floor() as i32)..=(range.end.ceil() as i32);
        let steps: &[f64] = if range.end - range.start > 2.5 { &[1.0] } else { &[1.0, 2.0, 5.0] };
        whole
            .flat_map(|power| steps.iter().map(move |step| f64::from(power) + step.log10()))
            .filter(|value| range.contains(value))
            .collect()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.inner.range()
    }
}

impl ValueFormatter<f64> for Axis {
    fn format_ext(&self, value: &f64) -> String {
        number(if self.log { 10f64.powf(*value) } else { *value })
    }
}

/// A number with as many digits as a label needs.
fn number(value: f64) -> String {
    let digits = match value.abs() {
        size if size >= 100.0 || size == 0.0 => 0,
        size if size >= 10.0 => 1,
        size if size >= 0.1 => 2,
        _ => return format!("{value:.0e}"),
    };
    let text = format!("{value:.digits$}");
    if digits > 0 { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// A little more than the values, and never empty.
fn padded(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    if low > high {
        return 0.0..1.0;
    }
    let margin = ((high - low) * 0.08).max(1e-6 + 0.01 * high.abs());
    low - margin..high + margin
}

/// Size of the names of marks, pixels.
const NAME_SIZE: i32 = 11;

/// Area of a plot that is taken, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Area {
    left: i32,
    top: i32,
    right: i32,
    bottom: i32,
}

impl Area {
    fn of_mark((x, y): (i32, i32)) -> Self {
        Self { left: x - 5, top: y - 5, right: x + 5, bottom: y + 5 }
    }

    fn meets(&self, other: &Self) -> bool {
        self.left < other.right
            && other.left < self.right
            && self.top < other.bottom
            && other.top < self.bottom
    }

    /// Where the name of a mark hides nothing that is taken; where nothing is free, the nearest place.
    fn beside((x, y): (i32, i32), name: &str, right_first: bool, taken: &[Self]) -> Self {
        let width = 6 * name.chars().count() as i32;
        let sides = [x + 8, x - 8 - width];
        let [near, far] = if right_first { sides } else { [sides[1], sides[0]] };
        // Below on the right and above on the left are off a front that rises; farther rows come last.
        let rows = |left: i32| if left > x { [6, -18, 20, -32] } else { [-18, 6, -32, 20] };
        let areas: [Self; 8] = std::array::from_fn(|k| {
            let left = [near, far][k % 2];
            let top = y + rows(left)[k / 2];
            Self { left, top, right: left + width, bottom: top + NAME_SIZE + 2 }
        });
        let is_free = |area: &&Self| !taken.iter().any(|other| area.meets(other));
        *areas.iter().find(is_free).unwrap_or(&areas[0])
    }
}

/// Draws a plot; none when nothing can be shown.
pub(crate) fn svg(plot: &Plot<'_>) -> Option<String> {
    let place = |x: f64| if plot.log { x.max(1e-9).log10() } else { x };
    let shown = || {
        plot.series
            .iter()
            .flat_map(|series| &series.points)
            .filter(|(x, y, _)| x.is_finite() && y.is_finite())
    };
    shown().next()?;
    let horizontal = Axis { inner: padded(shown().map(|(x, ..)| place(*x))).into(), log: plot.log };
    let vertical = Axis { inner: padded(shown().map(|(_, y, _)| *y)).into(), log: false };
    let mut text = String::new();
    draw(plot, place, horizontal, vertical, &mut text).ok()?;
    // The page sets the size; the view box keeps the shape.
    let (width, height) = plot.size;
    let fixed = format!("width=\"{width}\" height=\"{height}\"");
    Some(text.replacen(&fixed, "role=\"img\"", 1))
}

fn draw<'a>(
    plot: &Plot<'_>,
    place: impl Fn(f64) -> f64 + Copy,
    horizontal: Axis,
    vertical: Axis,
    text: &'a mut String,
) -> Result<(), DrawingAreaErrorKind<<SVGBackend<'a> as DrawingBackend>::ErrorType>> {
    let root = SVGBackend::with_string(text, plot.size).into_drawing_area();
    let middle = {
        let range = horizontal.range();
        (range.start + range.end) / 2.0
    };
    let mut chart = ChartBuilder::on(&root)
        .margin(10)
        .x_label_area_size(42)
        .y_label_area_size(58)
        .build_cartesian_2d(horizontal, vertical)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(GRID)
        .axis_style(INK)
        .x_desc(plot.axes[0])
        .y_desc(plot.axes[1])
        .x_labels(8)
        .y_labels(7)
        .label_style(("sans-serif", 13).into_font().color(&INK))
        .axis_desc_style(("sans-serif", 14).into_font().color(&INK))
        .draw()?;
    if plot.front.len() > 1 {
        let points: Vec<(f64, f64)> = plot.front.iter().map(|(x, y)| (place(*x), *y)).collect();
        let style = ShapeStyle::from(&INK.mix(0.45)).stroke_width(2);
        chart.draw_series(DashedLineSeries::new(points, 6, 5, style))?;
    }
    for (k, series) in plot.series.iter().enumerate() {
        let color = COLORS[k % COLORS.len()];
        let points: Vec<(f64, f64)> = series.points.iter().map(|(x, y, _)| (place(*x), *y)).collect();
        if series.line {
            chart
                .draw_series(LineSeries::new(points.clone(), ShapeStyle::from(&color).stroke_width(2)))?
                .label(&series.name)
                .legend(move |(x, y)| {
                    PathElement::new([(x, y), (x + 16, y)], ShapeStyle::from(&color).stroke_width(2))
                });
            chart.draw_series(points.iter().map(|point| Circle::new(*point, 3, color.filled())))?;
            continue;
        }
        let marks = points.iter().map(|point| Circle::new(*point, 5, color.filled()));
        chart
            .draw_series(marks)?
            .label(&series.name)
            .legend(move |(x, y)| Circle::new((x + 8, y), 5, color.filled()));
    }
    let marks = plot.series.iter().filter(|series| !series.line).flat_map(|series| &series.points);
    let pixels: Vec<(i32, i32)> =
        marks.clone().map(|(x, y, _)| chart.backend_coord(&(place(*x), *y))).collect();
    let mut taken: Vec<Area> = pixels.iter().copied().map(Area::of_mark).collect();
    for ((x, y, name), pixel) in marks.zip(pixels).filter(|((.., name), _)| !name.is_empty()) {
        // Towards the middle of the plot, where that is free.
        let area = Area::beside(pixel, name, place(*x) < middle, &taken);
        let offset = (area.left - pixel.0, area.top - pixel.1);
        taken.push(area);
        let style = ("sans-serif", NAME_SIZE).into_font().color(&INK.mix(0.85));
        let text = EmptyElement::at((place(*x), *y)) + Text::new(name.clone(), offset, style);
        chart.draw_series([text])?;
    }
    if plot.series.len() > 1 {
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::LowerRight)
            .background_style(WHITE.mix(0.85))
            .border_style(GRID)
            .label_font(("sans-serif", 12).into_font().color(&INK))
            .draw()?;
    }
    root.present()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plots_name_their_axes_series_and_points() {
        let series = |name: &str, line| Series {
            name: name.to_owned(),
            points: vec![(1.0, 20.0, "first".to_owned()), (100.0, 30.0, "a < b".to_owned())],
            line,
        };
        let plot = Plot {
            axes: ["processor time, s", "PSNR, dB"],
            log: true,
            series: vec![series("marks", false), series("line", true)],
            front: vec![(1.0, 20.0), (100.0, 30.0)],
            size: (640, 400),
        };
        let text = svg(&plot).unwrap();
        for word in [
            "<svg",
            "viewBox=\"0 0 640 400\"",
            "processor time, s",
            "PSNR, dB",
            "marks",
            "line",
            "first",
            "a &lt; b",
        ] {
            assert!(text.contains(word), "{word} in {text}");
        }
        assert!(!text.contains("http://www.w3.org/1999/xlink"), "nothing from elsewhere");
        assert_eq!(svg(&Plot { series: Vec::new(), ..plot }), None);
    }

    #[test]
    fn names_of_close_marks_do_not_lie_on_each_other() {
        let mut taken: Vec<Area> = [(100, 50), (103, 52), (97, 49)].map(Area::of_mark).into();
        for at in [(100, 50), (103, 52), (97, 49)] {
            let area = Area::beside(at, "planes 16", true, &taken);
            assert!(!taken.iter().any(|other| area.meets(other)), "{area:?} in {taken:?}");
            taken.push(area);
        }
        let alone = Area::beside((10, 10), "a", true, &[]);
        assert_eq!(alone, Area { left: 18, top: 16, right: 24, bottom: 29 });
        let everywhere = Area { left: -999, top: -999, right: 999, bottom: 999 };
        assert_eq!(Area::beside((10, 10), "a", true, &[everywhere]), alone, "nothing is free");
    }

    #[test]
    fn labels_have_few_digits() {
        for (value, text) in
            [(0.0, "0"), (120.4, "120"), (25.5, "25.5"), (25.0, "25"), (0.25, "0.25"), (1e-4, "1e-4")]
        {
            assert_eq!(number(value), text);
        }
    }
}
