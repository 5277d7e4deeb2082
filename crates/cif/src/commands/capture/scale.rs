//! Up and the metre of a capture, from what was said of them.

use std::collections::BTreeMap;

use cif_capture::frames::Shot;
use cif_capture::masks::Masks;
use cif_capture::similarity::Similarity;
use cif_capture::world::{self, Click};
use cif_capture::{Hooks, known_length};
use cif_dataset::meant::known_names;
use glam::{DVec2, DVec3};

use super::options::{Capture, UpName, positive};
use super::posed::Posed;
use crate::error::Error;

/// A length of the scene that is known.
pub(super) enum Known {
    /// The longest side of an object, by its id, in metres.
    Object(u16, f64),
    /// The distance of two points, by their pixels, in metres.
    Points([Vec<Click>; 2], f64),
    /// None.
    Nothing,
}

impl Known {
    /// As the command line says, which is checked before work is put into poses.
    pub(super) fn of(command: &Capture, masks: Option<&Masks>) -> Result<Self, Error> {
        Ok(match (&command.length, masks, &command.measured) {
            (Some(words), Some(masks), _) => {
                Self::Object(id_of(&words[0], masks)?, metres(&words[1], "--length")?)
            }
            (_, _, Some(words)) => {
                Self::Points([clicks(&words[0])?, clicks(&words[1])?], metres(&words[2], "--measured")?)
            }
            _ => Self::Nothing,
        })
    }
}

/// Turns and scales the world, and describes in two sentences how.
pub(super) fn settle(
    command: &Capture,
    known: &Known,
    shots: &[Shot],
    masks: Option<&Masks>,
    posed: &mut Posed,
    hooks: &Hooks<'_>,
) -> Result<Vec<String>, Error> {
    let mut lines = vec![up(command, posed)];
    let scale = match (known, masks) {
        (Known::Object(id, metres), Some(masks)) => {
            Some(metres / known_length::measure(*id, masks, shots, &posed.poses, hooks)?)
        }
        (Known::Points([a, b], metres), _) => {
            let (a, b) = (world::meet(&posed.poses, a)?, world::meet(&posed.poses, b)?);
            Some(world::scale_of(a, b, *metres)?)
        }
        _ => None,
    };
    lines.push(match scale {
        Some(scale) => {
            posed.poses.transform(&Similarity { scale, ..Similarity::IDENTITY });
            posed.metres_known = true;
            format!("a unit is a metre, by the known length (it was {scale:.4} m before)")
        }
        None if posed.metres_known => "a unit is a metre, as the other tool says".to_owned(),
        None => "the metre is not known: sizes, masses and falls of exported physics would be wrong; give --length \
                 or --measured"
            .to_owned(),
    });
    Ok(lines)
}

fn up(command: &Capture, posed: &mut Posed) -> String {
    match command.up {
        UpName::Given(direction) => {
            posed.poses.transform(&world::upright(DVec3::from(direction)));
            posed.up_known = true;
            "+z is up, as given".to_owned()
        }
        UpName::Cameras if posed.up_known => "+z is up, as the other tool says".to_owned(),
        UpName::Cameras => match world::up_of_cameras(&posed.poses) {
            Some(direction) => {
                posed.poses.transform(&world::upright(direction));
                posed.up_known = true;
                "+z is up, by how the cameras were held (--up sets another direction)".to_owned()
            }
            None => "up is not known: the cameras were held every way; gravity of exported physics would be wrong \
                     (--up X,Y,Z sets it)"
                .to_owned(),
        },
        UpName::Unknown => {
            posed.up_known = false;
            "up is not known, as was said; gravity of exported physics would be wrong".to_owned()
        }
    }
}

fn metres(text: &str, flag: &str) -> Result<f64, Error> {
    positive(text).map_err(|problem| {
        Error::usage(format!("{flag}: {text:?}: {problem}"), "give the length in metres, as in 0.09")
    })
}

/// The id of an object by its label or its number.
fn id_of(name: &str, masks: &Masks) -> Result<u16, Error> {
    let labels = match masks.labels() {
        Some(file) => cif_dataset::masks::read_labels(&file).map_err(Error::plain)?,
        None => BTreeMap::new(),
    };
    let labelled = labels.values().find(|instance| instance.label == name).map(|instance| instance.id);
    labelled.or_else(|| name.parse().ok().filter(|id| *id > 0)).ok_or_else(|| {
        let known: Vec<String> = labels.values().map(|instance| instance.label.clone()).collect();
        let known = if known.is_empty() {
            "there is no instances.json".to_owned()
        } else {
            known_names(name, "it has", &known)
        };
        Error::failed(
            format!("{}: no object is called {name:?}", masks.folder.display()),
            format!("give the id of one that stands still, or a label of its instances.json: {known}"),
        )
    })
}

/// `IMAGE:X,Y/IMAGE:X,Y`.
fn clicks(text: &str) -> Result<Vec<Click>, Error> {
    let click = |part: &str| {
        let (image, pixel) = part.rsplit_once(':')?;
        let (x, y) = pixel.split_once(',')?;
        let number = |text: &str| text.trim().parse().ok().filter(|value: &f64| value.is_finite());
        Some(Click { image: image.to_owned(), pixel: DVec2::new(number(x)?, number(y)?) })
    };
    // Folders of images have the same sign: a part without a pixel belongs to the next one.
    let mut parts: Vec<String> = Vec::new();
    for part in text.split('/') {
        match parts.last_mut().filter(|last| !last.contains(':')) {
            Some(last) => *last += &format!("/{part}"),
            None => parts.push(part.to_owned()),
        }
    }
    parts.iter().map(|part| click(part)).collect::<Option<Vec<_>>>().ok_or_else(|| {
        Error::usage(
            format!("--measured: {text:?} is no point"),
            "give the pixel of the point in two or more images, as in 000000.png:120,84/000040.png:98,80",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_pixels_of_several_images() {
        let found = clicks("000000.png:120,84.5/left/000040.png:98,80").unwrap();
        let shown: Vec<(&str, f64, f64)> =
            found.iter().map(|click| (click.image.as_str(), click.pixel.x, click.pixel.y)).collect();
        assert_eq!(shown, [("000000.png", 120.0, 84.5), ("left/000040.png", 98.0, 80.0)]);
        for wrong in ["a.png", "a.png:1", "a.png:1,x", "a.png:1,2/b.png"] {
            assert!(clicks(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn up_is_read() {
        assert_eq!("0,-1,0".parse(), Ok(UpName::Given([0.0, -1.0, 0.0])));
        assert_eq!("unknown".parse(), Ok(UpName::Unknown));
        for wrong in ["", "z", "0,0,0", "1,2", "1,2,nan"] {
            assert!(wrong.parse::<UpName>().is_err(), "{wrong}");
        }
    }
}
