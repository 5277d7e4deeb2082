//! Times on the command line: one unit by default, the others by a suffix.
//!
//! | typed | means |
//! |---|---|
//! | `36` | frame 36, which is time code 36 of the exported stage; fractions lie between frames |
//! | `1.5s` | one and a half seconds after the first frame |
//! | `50%` | halfway from the first frame to the last |
//!
//! A scene, its stage and its glTF file give the same answer to the same words.

use std::fmt;
use std::str::FromStr;

use cif_field::Field;
use cif_scene::CodeRange;

use crate::error::Error;

/// A time as it was typed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Moment {
    /// A frame, that is a time code.
    Frame(f64),
    /// Seconds after the first frame.
    Seconds(f64),
    /// A share of the time from the first frame to the last, percent.
    Percent(f64),
}

impl FromStr for Moment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (number, make): (&str, fn(f64) -> Self) = match (text.strip_suffix('s'), text.strip_suffix('%')) {
            (Some(number), _) => (number, Self::Seconds),
            (_, Some(number)) => (number, Self::Percent),
            _ => (text, Self::Frame),
        };
        let number = number.trim().parse().ok().filter(|number: &f64| number.is_finite());
        number.map(make).ok_or_else(|| "a frame (36), seconds (1.5s) or a share (50%) is expected".to_owned())
    }
}

impl fmt::Display for Moment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Frame(frame) => write!(f, "{frame}"),
            Self::Seconds(seconds) => write!(f, "{seconds}s"),
            Self::Percent(percent) => write!(f, "{percent}%"),
        }
    }
}

/// An interval of time as it was typed, `FROM:TO`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Interval {
    from: Moment,
    to: Moment,
}

impl FromStr for Interval {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (from, to) = text.split_once(':').ok_or_else(|| {
            "two times are expected, the earlier one first: 0:20, 0s:1.5s or 0%:50%".to_owned()
        })?;
        Ok(Self { from: from.trim().parse()?, to: to.trim().parse()? })
    }
}

/// The frames that a scene or file has, by which times are understood.
pub(crate) struct Frames<'a> {
    range: CodeRange,
    /// Name of the scene or file.
    place: &'a str,
}

impl<'a> Frames<'a> {
    pub(crate) fn new(range: CodeRange, place: &'a str) -> Self {
        Self { range, place }
    }

    /// Those of a field, which its stage has as time codes.
    pub(crate) fn of(field: &Field, place: &'a str) -> Self {
        let codes = field.time_codes();
        let ends = codes.first().copied().zip(codes.last().copied()).unwrap_or_default();
        Self::new(CodeRange { ends: Some(ends), per_second: field.timeline.frames_per_second }, place)
    }

    /// Time code of a moment, inside the range.
    ///
    /// # Errors
    /// Outside of it, naming it.
    pub(crate) fn code(&self, flag: &str, moment: Moment) -> Result<f64, Error> {
        let code = self.unchecked(flag, moment)?;
        if self.holds(code, code) { Ok(code) } else { Err(self.outside(&format!("{flag} {moment}"))) }
    }

    /// Time codes of an interval that overlaps the range.
    ///
    /// # Errors
    /// When it does not, or its ends are in the wrong order.
    pub(crate) fn interval(&self, flag: &str, interval: Interval) -> Result<(f64, f64), Error> {
        let Interval { from, to } = interval;
        let (first, last) = (self.unchecked(flag, from)?, self.unchecked(flag, to)?);
        if first > last {
            return Err(Error::usage(
                format!("{flag} {from}:{to}: the earlier time comes first"),
                format!("give {flag} {to}:{from}"),
            ));
        }
        if self.holds(first, last) {
            Ok((first, last))
        } else {
            Err(self.outside(&format!("{flag} {from}:{to}")))
        }
    }

    /// True where an interval of time codes overlaps the range. Rounding of seconds and shares may leave it by a
    /// part in a thousand million.
    fn holds(&self, first: f64, last: f64) -> bool {
        self.range.ends.is_none_or(|(start, end)| {
            let slack = 1e-9 * (1.0 + start.abs().max(end.abs()));
            last >= start - slack && first <= end + slack
        })
    }

    fn unchecked(&self, flag: &str, moment: Moment) -> Result<f64, Error> {
        let start = self.range.ends.map_or(0.0, |(start, _)| start);
        match (moment, self.range.ends) {
            (Moment::Frame(code), _) => Ok(code),
            (Moment::Seconds(seconds), _) => Ok(start + seconds * self.range.per_second),
            (Moment::Percent(percent), Some((start, end))) => Ok(start + percent / 100.0 * (end - start)),
            (Moment::Percent(_), None) => Err(Error::usage(
                format!("{flag} {moment}: {} does not say its first and last time code", self.place),
                format!("give a time code, for example {flag} 36"),
            )),
        }
    }

    fn outside(&self, asked: &str) -> Error {
        let (start, end) = self.range.ends.unwrap_or_default();
        if end <= start {
            return Error::usage(
                format!("{asked}: {} shows one moment, frame {start}", self.place),
                "leave the time out",
            );
        }
        let seconds = (end - start) / self.range.per_second;
        Error::usage(
            format!(
                "{asked} is outside {}, which has frames {start} to {end}, {seconds:.2} seconds",
                self.place
            ),
            format!("give a frame from {start} to {end}, seconds from 0s to {seconds:.2}s, or 0% to 100%"),
        )
    }
}

/// Says so where a number between 0 and 1 was typed, as times of scenes once were: it is a part of the first frame.
pub(crate) fn note_fraction(flag: &str, moment: Moment) {
    if let Moment::Frame(frame) = moment
        && frame > 0.0
        && frame < 1.0
    {
        crate::messages::note!(
            "{flag} {frame} lies between frames 0 and 1; {}% is that share of the whole",
            100.0 * frame
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(place: &str) -> Frames<'_> {
        Frames::new(CodeRange { ends: Some((10.0, 40.0)), per_second: 20.0 }, place)
    }

    fn code(text: &str) -> Result<f64, Error> {
        frames("a.usda").code("--time", text.parse().unwrap())
    }

    #[test]
    fn units_follow_the_suffix() {
        for (text, expected) in
            [("36", 36.0), ("10.5", 10.5), ("0s", 10.0), ("1.5s", 40.0), ("50%", 25.0), ("100 %", 40.0)]
        {
            assert_eq!(code(text).unwrap(), expected, "{text}");
        }
        for text in ["", "s", "%", "36f", "nan", "inf", "infs", "1:2", "1,5"] {
            assert!(text.parse::<Moment>().is_err(), "{text}");
        }
        assert_eq!("-3".parse(), Ok(Moment::Frame(-3.0)));
    }

    #[test]
    fn times_outside_name_the_range() {
        for text in ["200", "9", "2s", "-1s", "101%"] {
            let error = code(text).unwrap_err();
            let words = error.to_string();
            assert!(words.contains(&format!("--time {text} is outside a.usda")), "{words}");
            assert!(words.contains("frames 10 to 40, 1.50 seconds"), "{words}");
            assert_eq!(error.exit_code(), 2);
        }
        let still = Frames::new(CodeRange { ends: Some((0.0, 0.0)), per_second: 24.0 }, "a.ply");
        let error = still.code("--time", Moment::Frame(3.0)).unwrap_err().to_string();
        assert!(error.contains("a.ply shows one moment, frame 0"), "{error}");
        let unknown = Frames::new(CodeRange { ends: None, per_second: 24.0 }, "a.usda");
        assert_eq!(unknown.code("--time", Moment::Frame(300.0)).unwrap(), 300.0);
        assert_eq!(unknown.code("--time", Moment::Seconds(2.0)).unwrap(), 48.0);
        assert!(unknown.code("--time", Moment::Percent(2.0)).is_err());
    }

    #[test]
    fn intervals_overlap_the_range_in_order() {
        let interval = |text: &str| frames("a.usda").interval("--interval", text.parse().unwrap());
        assert_eq!(interval("12:30.5").unwrap(), (12.0, 30.5));
        assert_eq!(interval("0:100").unwrap(), (0.0, 100.0), "ends may lie outside");
        assert_eq!(interval("0s : 50%").unwrap(), (10.0, 25.0));
        assert!(interval("30:12").unwrap_err().to_string().contains("the earlier time comes first"));
        assert!(interval("50:60").unwrap_err().to_string().contains("frames 10 to 40"));
        for text in ["3", "a:b", "nan:1", "0:inf"] {
            assert!(text.parse::<Interval>().is_err(), "{text}");
        }
    }
}
