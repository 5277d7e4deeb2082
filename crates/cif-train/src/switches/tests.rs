use super::*;

const RED: [u8; 3] = [200, 30, 30];
const GREEN: [u8; 3] = [30, 180, 40];
const BLUE: [u8; 3] = [30, 60, 210];
const GREY: [u8; 3] = [120, 120, 120];
const STRIPES: [[u8; 3]; 2] = [[240, 240, 230], [20, 20, 120]];

const SIZE: [u32; 2] = [60, 20];

/// A rectangle of pixels: left, top, width and height.
type Rectangle = [u32; 4];

/// An image of one value with rectangles of others.
fn painted<T: Copy>(filled: T, rectangles: &[(T, Rectangle)]) -> PixelGrid<T> {
    let mut grid = PixelGrid::filled(SIZE[0], SIZE[1], filled);
    for (value, [left, top, width, height]) in rectangles {
        for at in 0..width * height {
            let (x, y) = (left + at % width, top + at / width);
            grid.pixels[(y * SIZE[0] + x) as usize] = *value;
        }
    }
    grid
}

/// Frame `time` of a camera: what is there (colour and rectangle), and what is labelled (label and rectangle).
fn frame(time: usize, things: &[([u8; 3], Rectangle)], masks: &[(u16, Rectangle)]) -> Seen {
    Seen::of(&painted(GREY, things), Some(&painted(UNLABELLED, masks)), "camera", time)
}

/// New labels of masks by their old ones, and nothing else.
fn renamed(renamed: BTreeMap<u16, u16>) -> Correction {
    Correction { renamed, foreign: BTreeMap::new() }
}

/// A red thing (1), a green one (2) and a striped one (3) in shadow and light; `shown` selects which a mask shows.
fn frames(count: usize, shown: impl Fn(usize, u16) -> Option<u16>) -> Vec<Seen> {
    let frame = |k: usize| {
        let label_at = |at: u32| (at % 30 / 10) as u16 + 1;
        let color = |at: u32| {
            let light = 0.9 + 0.1 * (k as f64 + f64::from(at) * 0.01).sin();
            let color = match shown(k, label_at(at)) {
                Some(1) => RED,
                Some(2) => GREEN,
                _ => STRIPES[(at / 2 % 2) as usize],
            };
            color.map(|c| (f64::from(c) * light) as u8)
        };
        let label = |at: u32| Some(label_at(at)).filter(|label| shown(k, *label).is_some()).unwrap_or(0);
        let image = PixelGrid::from_pixels(30, 10, (0..300).map(color).collect());
        let labels = PixelGrid::from_pixels(30, 10, (0..300).map(label).collect());
        Seen::of(&image, Some(&labels), "camera", k)
    };
    (0..count).map(frame).collect()
}

#[test]
fn exchanged_masks_are_put_back_and_others_are_taken_away() {
    let shown = |k: usize, label: u16| match (k, label) {
        (5 | 6, 1) => Some(2),
        (5 | 6, 2) => Some(1),
        // The red thing is hidden, and its mask on the striped one.
        (11, 1) => Some(3),
        // One mask is missing, which is no switch.
        (13, 2) => None,
        (_, label) => Some(label),
    };
    let found = corrections(&frames(20, shown));
    for (k, correction) in found.iter().enumerate() {
        let expected = match k {
            5 | 6 => BTreeMap::from([(1, 2), (2, 1)]),
            11 => BTreeMap::from([(1, UNLABELLED)]),
            _ => BTreeMap::new(),
        };
        assert_eq!(*correction, renamed(expected), "frame {k}");
    }
    let labels = PixelGrid::from_pixels(3, 1, vec![1, 2, 3]);
    assert_eq!(found[5].applied(&labels).pixels, [2, 1, 3]);
}

#[test]
fn light_and_twins_and_too_many_switches_change_nothing() {
    assert!(corrections(&frames(20, |_, label| Some(label))).iter().all(Correction::is_none));
    let twins = |k: usize, label: u16| Some(if label == 2 || k == 7 { 1 } else { label });
    let found = corrections(&frames(20, twins));
    assert!(found.iter().all(|of| !of.renamed.contains_key(&1) && !of.renamed.contains_key(&2)), "{found:?}");
    let often = |k: usize, label: u16| Some(if k.is_multiple_of(2) && label < 3 { 3 - label } else { label });
    assert!(corrections(&frames(20, often)).iter().all(Correction::is_none));
    assert!(corrections(&frames(4, |k, l| Some(if k == 1 { 2 } else { l }))).iter().all(Correction::is_none));
    assert!(corrections(&[]).is_empty());
}

/// Two things of these colours, one of which moves, with their labels exchanged in some of 20 frames.
fn pair(colors: [[u8; 3]; 2], exchanged: impl Fn(usize) -> bool) -> Vec<Seen> {
    let frame = |k: usize| {
        let places = [[5 + k as u32 / 2, 4, 8, 8], [40, 6, 8, 8]];
        let labels = if exchanged(k) { [2, 1] } else { [1, 2] };
        let things = [0, 1].map(|thing| (colors[thing], places[thing]));
        frame(k, &things, &[0, 1].map(|thing| (labels[thing], places[thing])))
    };
    (0..20).map(frame).collect()
}

#[test]
fn masks_of_equal_things_that_change_places_are_put_back() {
    let both = renamed(BTreeMap::from([(1, 2), (2, 1)]));
    // For a while, until the end, and from the beginning.
    for span in [8..12, 15..20, 0..4] {
        let found = corrections(&pair([RED, RED], |k| span.contains(&k)));
        for (k, correction) in found.iter().enumerate() {
            assert_eq!(*correction == both, span.contains(&k), "frame {k} of {span:?}: {correction:?}");
        }
    }
    // Nobody knows which is which.
    assert!(corrections(&pair([RED, RED], |k| k < 9)).iter().all(Correction::is_none));
}

#[test]
fn colors_overrule_places() {
    // Two things that do change places: the masks follow their colours.
    let crossing = |k: usize| {
        let places = [[5, 4, 8, 8], [40, 6, 8, 8]];
        let places = if k < 16 { places } else { [places[1], places[0]] };
        frame(k, &[(RED, places[0]), (GREEN, places[1])], &[(1, places[0]), (2, places[1])])
    };
    let found = corrections(&(0..20).map(crossing).collect::<Vec<_>>());
    assert!(found.iter().all(Correction::is_none), "{found:?}");
}

/// A red thing (1) that stands beside a blue one (2), whose mask is another one in one of 20 frames.
fn resting(at: usize, mask: Rectangle) -> Vec<Seen> {
    let (red, blue) = ([10, 5, 8, 8], [18, 5, 20, 8]);
    let frame = |k: usize| {
        let of_red = if k == at { mask } else { red };
        frame(k, &[(RED, red), (BLUE, blue)], &[(2, blue), (1, of_red)])
    };
    (0..20).map(frame).collect()
}

#[test]
fn masks_without_the_place_and_the_colors_of_their_object_are_taken_away() {
    let taken = |seen: &[Seen]| -> Vec<usize> {
        let found = corrections(seen);
        let of_red = |of: &Correction| of.renamed.get(&1) == Some(&UNLABELLED);
        assert!(found.iter().all(|of| !of.renamed.contains_key(&2)), "{found:?}");
        (0..found.len()).filter(|k| of_red(&found[*k])).collect()
    };
    // On the ground somewhere else, and over the edge of the blue thing as well.
    assert_eq!(taken(&resting(7, [45, 12, 5, 5])), [7]);
    assert_eq!(taken(&resting(7, [10, 5, 20, 8])), [7]);
    // A part of it, of its colours; a little too large; and where it is, but of another colour, as in a shadow.
    assert!(taken(&resting(7, [10, 5, 3, 8])).is_empty());
    assert!(taken(&resting(7, [9, 4, 10, 9])).is_empty());
    let shadow = |k: usize| {
        let color = if (5..9).contains(&k) { [60, 10, 10] } else { RED };
        frame(k, &[(color, [10, 5, 8, 8])], &[(1, [10, 5, 8, 8])])
    };
    assert!(taken(&(0..20).map(shadow).collect::<Vec<_>>()).is_empty());
    // Where the camera jumps, only colours help.
    let jumps = |k: usize| {
        let left = if k.is_multiple_of(2) { 5 } else { 40 };
        let mask = if k == 7 { [20, 10, 8, 8] } else { [left, 5, 8, 8] };
        frame(k, &[(RED, [left, 5, 8, 8])], &[(1, mask)])
    };
    assert_eq!(taken(&(0..20).map(jumps).collect::<Vec<_>>()), [7]);
}

#[test]
fn sightings_of_a_moment_with_foreign_colors_are_taken_away() {
    // A red thing that comes in late and moves by more than its width; masks before that are a third on something red.
    let seen = |moment: &[usize], red: u32| {
        let frame = |k: usize| {
            let left = (5 * k as u32) % 45;
            let things = if k < 8 { [48, 12, red, 6] } else { [left, 2, 4, 8] };
            let masks: &[(u16, Rectangle)] = match k {
                0..8 if moment.contains(&k) => &[(1, [48, 12, 6, 6])],
                0..8 => &[],
                _ => &[(1, [left, 2, 4, 8])],
            };
            frame(k, &[(RED, things)], masks)
        };
        let found = corrections(&(0..32).map(frame).collect::<Vec<_>>());
        (0..found.len()).filter(|k| !found[*k].is_none()).collect::<Vec<_>>()
    };
    assert_eq!(seen(&[3], 2), [3]);
    assert_eq!(seen(&[0, 5, 6], 2), [0, 5, 6]);
    // What has its colours may be it, and so may what is seen for longer, as in a shadow.
    assert!(seen(&[3], 6).is_empty());
    assert!(seen(&[2, 3, 4, 5], 2).is_empty());
}

#[test]
fn blobs_apart_from_a_mask_lose_its_label() {
    // A red thing (1) beside a blue one (2) that hides the middle of it at the end; masks of the red one have blobs.
    let blue = [30, 3, 9, 12];
    let seen = |blobs: &dyn Fn(usize) -> Vec<Rectangle>| {
        let frame = |k: usize| {
            let masks: Vec<(u16, Rectangle)> = match k {
                ..16 => vec![(1, [4, 4, 8, 10])],
                // Two pieces of it.
                _ => vec![(1, [4, 4, 2, 10]), (1, [10, 4, 2, 10])],
            };
            let blobs = blobs(k).into_iter().map(|blob| (1, blob));
            let things = [(RED, [4, 4, 8, 10]), (BLUE, blue)];
            frame(k, &things, &[vec![(2, blue)], masks, blobs.collect()].concat())
        };
        corrections(&(0..20).map(frame).collect::<Vec<_>>())
    };
    assert!(seen(&|_| Vec::new()).iter().all(Correction::is_none));
    // On the ground, and on the blue thing.
    let found = seen(&|k| match k {
        7 => vec![[50, 12, 4, 4], [32, 5, 4, 4]],
        _ => Vec::new(),
    });
    assert!(found.iter().enumerate().all(|(k, of)| of.is_none() == (k != 7)), "{found:?}");
    assert_eq!(found[7].foreign[&1].len(), 2);
    let clean = [(2, blue), (1, [4, 4, 8, 10])];
    let blobs = [&clean[..], &[(1, [50, 12, 4, 4]), (1, [32, 5, 4, 4])]].concat();
    assert_eq!(found[7].applied(&painted(UNLABELLED, &blobs)).pixels, painted(UNLABELLED, &clean).pixels);
    // Near it; borne out by the frames before and after; in most frames.
    assert!(seen(&|k| if k == 7 { vec![[13, 6, 4, 4]] } else { Vec::new() }).iter().all(Correction::is_none));
    let stays = seen(&|k| if (6..9).contains(&k) { vec![[50, 12, 4, 4]] } else { Vec::new() });
    assert!(stays.iter().all(Correction::is_none));
    let often = seen(&|k| if k % 2 == 0 { vec![[20 + k as u32, 12, 4, 4]] } else { Vec::new() });
    assert!(often.iter().all(Correction::is_none));
}
