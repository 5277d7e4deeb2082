//! Frames of videos through ffmpeg: one pass looks at all of them, another writes those that are taken.

use std::ffi::OsStr;
use std::path::Path;
use std::process::Command;

use super::choose::{Seen, choose};
use super::{Choice, Notes, Shot};
use crate::child::{self, Answer};
use crate::picture::{HEIGHT, Impression, WIDTH};
use crate::source::Source;
use crate::{Error, Hooks};

/// Shares of the median distance between frames by which distances may differ in a video of constant rate.
const VARIES: f64 = 0.2;

/// Frames of a video, written as `<number in the stream>.png`.
pub(super) fn read(
    source: &Source,
    prefix: &str,
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    read_with(OsStr::new("ffmpeg"), source, prefix, choice, folder, hooks, notes)
}

fn read_with(
    ffmpeg: &OsStr,
    source: &Source,
    prefix: &str,
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    let shown = source.path.display();
    cif_input::check(&source.path).map_err(Error::io("read", &source.path))?;
    hooks.tell(&format!("looking at {}", source.camera));
    let mut seen = look(ffmpeg, source, hooks)?;
    let start = seen[0].time;
    let offset = choice.offsets_s.get(&source.camera).copied().unwrap_or(0.0);
    seen.iter_mut().for_each(|frame| frame.time += offset);
    if let Some(varies) = spread_of_distances(&seen).filter(|spread| *spread > VARIES) {
        notes.push(format!(
            "{shown}: the distance between frames varies by {:.0} %; times are those of the stream",
            100.0 * varies
        ));
    }
    let black = seen.iter().filter(|frame| frame.impression.is_empty()).count();
    if black > 0 {
        notes.push(format!(
            "{shown}: {black} of {} frames are black or of one colour and are left out",
            seen.len()
        ));
    }
    let taken = choose(&seen, choice);
    if taken.is_empty() {
        return Err(Error::refused(
            format!(
                "{shown}: no frame can be taken: all are black, of one colour, or outside --from and --to"
            ),
            "check the video, and the range of seconds",
        ));
    }
    hooks.tell(&format!("{} of {} frames of {}", taken.len(), seen.len(), source.camera));
    let into = folder.join(&source.camera);
    std::fs::create_dir_all(&into).map_err(Error::io("create", &into))?;
    write(ffmpeg, source, &taken, choice.max_side, &into, hooks)?;
    let mut shots = Vec::with_capacity(taken.len());
    for (number, k) in taken.iter().enumerate() {
        let written = into.join(format!("taken{number:06}.png"));
        let name = format!("{k:06}.png");
        let file = into.join(&name);
        std::fs::rename(&written, &file).map_err(|_| {
            Error::refused(
                format!("{shown}: ffmpeg wrote {number} of {} frames", taken.len()),
                "check the video, as with ffmpeg -i VIDEO -f null -",
            )
        })?;
        let size = image::image_dimensions(&file).map_err(|error| {
            Error::refused(format!("{}: ffmpeg wrote no image: {error}", file.display()), "check the video")
        })?;
        shots.push(Shot {
            camera: source.camera.clone(),
            name: format!("{prefix}{name}"),
            file,
            time: Some(seen[*k].time - start),
            size,
            impression: seen[*k].impression.clone(),
        });
    }
    Ok(shots)
}

/// Runs ffmpeg; frames come as they are in the stream, none doubled and none dropped. `-fps_mode` says so from
/// 5.1 on, `-vsync` before.
fn run(
    ffmpeg: &OsStr,
    source: &Source,
    filter: &str,
    output: &[&OsStr],
    hooks: &Hooks<'_>,
    mut line: impl FnMut(&str) + Send,
) -> Result<Answer, Error> {
    let shown = source.path.display();
    let mut old = false;
    loop {
        let mut command = Command::new(ffmpeg);
        command.args(["-nostdin", "-hide_banner", "-nostats", "-i"]).arg(&source.path);
        command.args(["-an", "-sn", "-dn", "-vf", filter]);
        command.args(if old { ["-vsync", "passthrough"] } else { ["-fps_mode", "passthrough"] });
        command.args(output);
        let answer = child::run(&mut command, b"", hooks.should_stop, &mut line)?.ok_or_else(|| {
            Error::refused(
                format!("{shown}: videos are read by ffmpeg, which is not installed or not on the PATH"),
                "install it (apt install ffmpeg, brew install ffmpeg, winget install ffmpeg), or give a folder of \
                 extracted frames",
            )
        })?;
        if answer.succeeded {
            return Ok(answer);
        }
        if !old && answer.last_words.contains("fps_mode") {
            old = true;
            continue;
        }
        let words = answer.last_words.lines().last().unwrap_or("it gave no reason").to_owned();
        let holds_none = ["does not contain any stream", "matches no streams", "Invalid data found"];
        return Err(if holds_none.iter().any(|sign| answer.last_words.contains(sign)) {
            Error::refused(
                format!("{shown}: ffmpeg finds no pictures in it: {words}"),
                "give a video file, or a folder of photographs",
            )
        } else {
            Error::refused(
                format!("{shown}: ffmpeg fails: {words}"),
                "check the video, or extract its frames by hand",
            )
        });
    }
}

/// All frames of a video as they look from afar.
fn look(ffmpeg: &OsStr, source: &Source, hooks: &Hooks<'_>) -> Result<Vec<Seen>, Error> {
    let mut times = Vec::new();
    let filter = format!("showinfo,scale={WIDTH}:{HEIGHT}:flags=bilinear,format=gray");
    let output = ["-f", "rawvideo", "-"].map(OsStr::new);
    let answer = run(ffmpeg, source, &filter, &output, hooks, |line| times.extend(time_of(line)))?;
    let frames = answer.output.chunks_exact(WIDTH * HEIGHT);
    if frames.len() == 0 || times.len() < frames.len() {
        return Err(Error::refused(
            format!("{}: the video has no frames that ffmpeg can decode", source.path.display()),
            "check that it plays, or give a folder of photographs",
        ));
    }
    // A second try of an older ffmpeg told its times again.
    let times = times.split_off(times.len() - frames.len());
    let mut seen: Vec<Seen> = times
        .into_iter()
        .zip(frames)
        .map(|(time, grey)| Seen { time, impression: Impression::of(grey) })
        .collect();
    // Streams now and then repeat or turn back a time; what follows is no earlier.
    for k in 1..seen.len() {
        seen[k].time = seen[k].time.max(seen[k - 1].time);
    }
    Ok(seen)
}

/// The time of a frame in a line of the filter `showinfo`.
fn time_of(line: &str) -> Option<f64> {
    let (_, rest) = line.split_once("showinfo").and_then(|(_, rest)| rest.split_once("pts_time:"))?;
    rest.split_whitespace().next()?.parse().ok().filter(|time: &f64| time.is_finite())
}

/// Largest deviation of distances between frames from their median, as a share of it; `None` for less than
/// three.
fn spread_of_distances(seen: &[Seen]) -> Option<f64> {
    let mut distances: Vec<f64> = seen.windows(2).map(|pair| pair[1].time - pair[0].time).collect();
    distances.sort_by(f64::total_cmp);
    let median = *distances.get(distances.len() / 2).filter(|_| distances.len() > 1)?;
    let (low, high) = (distances.first()?, distances.last()?);
    (median > 0.0).then(|| (high - median).max(median - low) / median)
}

/// Writes frames as `taken000000.png`, ... in order.
fn write(
    ffmpeg: &OsStr,
    source: &Source,
    taken: &[usize],
    max_side: Option<u32>,
    into: &Path,
    hooks: &Hooks<'_>,
) -> Result<(), Error> {
    // Runs of neighbours are one term: long lists of single frames are slow, and too long for a command line.
    let mut terms: Vec<String> = Vec::new();
    for run in taken.chunk_by(|a, b| a + 1 == *b) {
        terms.push(format!("between(n,{},{})", run[0], run[run.len() - 1]));
    }
    let mut filter = format!("select='{}'", terms.join("+"));
    if let Some(side) = max_side {
        // Even sizes, as most codecs have; never larger than it is.
        filter += &format!(
            ",scale='if(gte(iw,ih),min(iw,{side}),-2)':'if(gte(iw,ih),-2,min(ih,{side}))':flags=area"
        );
    }
    let pattern = into.join("taken%06d.png");
    let output = [OsStr::new("-start_number"), OsStr::new("0"), pattern.as_os_str()];
    run(ffmpeg, source, &filter, &output, hooks, |_| ()).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(path: &Path) -> Source {
        Source { camera: "walk".to_owned(), path: path.to_owned(), photographs: None }
    }

    /// A small test video made by ffmpeg; `None` where there is no ffmpeg.
    fn video(folder: &Path, filter: &str, name: &str) -> Option<std::path::PathBuf> {
        let path = folder.join(name);
        let made = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", filter, "-c:v", "ffv1"])
            .arg(&path)
            .status();
        if made.is_err() {
            eprintln!("skipped: there is no ffmpeg");
        }
        made.ok().map(|status| {
            assert!(status.success());
            path
        })
    }

    #[test]
    fn lines_of_showinfo_tell_times() {
        let line = "[Parsed_showinfo_0 @ 0x55] n:   3 pts:    300 pts_time:0.3     pos:      1 fmt:yuv420p";
        assert_eq!(time_of(line), Some(0.3));
        assert_eq!(time_of("[Parsed_showinfo_0 @ 0x55] n:   3 pts:   NOPTS pts_time:NOPTS"), None);
        assert_eq!(time_of("frame= 12 pts_time:0.3"), None);
    }

    #[test]
    fn frames_are_written_with_their_times() {
        let folder = tempfile::tempdir().unwrap();
        let filter = "testsrc=duration=2:size=96x64:rate=10";
        let Some(path) = video(folder.path(), filter, "walk.mkv") else { return };
        let choice =
            Choice { rate: Some(2.5), sharpest: Some(false), max_side: Some(48), ..Choice::default() };
        let mut notes = Notes::new();
        let hooks = Hooks::silent();
        let shots = read(&source(&path), "", &choice, folder.path(), &hooks, &mut notes).unwrap();
        let names: Vec<&str> = shots.iter().map(|shot| shot.name.as_str()).collect();
        assert_eq!(names, ["000000.png", "000004.png", "000008.png", "000012.png", "000016.png"]);
        for (k, shot) in shots.iter().enumerate() {
            assert!((shot.time.unwrap() - 0.4 * k as f64).abs() < 2e-3, "{:?}", shot.time);
            assert_eq!(shot.size, (48, 32));
            assert_eq!(image::image_dimensions(&shot.file).unwrap(), (48, 32));
        }
        assert!(notes.is_empty(), "{notes:?}");
        // The pixels are those of the frames asked for: the clock of the test picture has gone on.
        let pixels = |k: usize| std::fs::read(&shots[k].file).unwrap();
        assert_ne!(pixels(0), pixels(3));
    }

    #[test]
    fn cameras_that_began_at_other_times_show_the_same_moments() {
        let folder = tempfile::tempdir().unwrap();
        let filter = "testsrc=duration=2:size=96x64:rate=10";
        let Some(path) = video(folder.path(), filter, "walk.mkv") else { return };
        let sources = ["a", "b"].map(|name| Source { camera: name.to_owned(), ..source(&path) });
        // b began half a second before a, so that its frame 5 shows the moment of the first of a.
        let offsets_s = [("b".to_owned(), -0.5)].into();
        let choice = Choice { rate: Some(2.0), offsets_s, ..Choice::default() };
        let hooks = Hooks::silent();
        let shots =
            crate::frames::collect(&sources, &choice, folder.path(), &hooks, &mut Notes::new()).unwrap();
        let of = |camera: &str| -> Vec<(String, i64)> {
            let shots = shots.iter().filter(|shot| shot.camera == camera);
            shots.map(|s| (s.name.clone(), (s.time.unwrap() * 1e3).round() as i64)).collect()
        };
        let frames = |camera: &str, first: usize, count: usize| -> Vec<(String, i64)> {
            (0..count).map(|k| (format!("{camera}/{:06}.png", first + 5 * k), 500 * k as i64)).collect()
        };
        assert_eq!(of("a"), frames("a", 0, 4));
        assert_eq!(of("b"), frames("b", 5, 3));
    }

    #[test]
    fn variable_rates_and_black_frames_are_told() {
        let folder = tempfile::tempdir().unwrap();
        // Every third frame is dropped, and the first second is black.
        let filter = "testsrc=duration=3:size=96x64:rate=10,drawbox=t=fill:color=black:enable='lt(t,1)',\
                      select='mod(n,3)'";
        let Some(path) = video(folder.path(), filter, "walk.mkv") else { return };
        let mut notes = Notes::new();
        let hooks = Hooks::silent();
        let shots = read(&source(&path), "", &Choice::default(), folder.path(), &hooks, &mut notes).unwrap();
        assert!(notes.iter().any(|note| note.contains("varies by 100 %")), "{notes:?}");
        assert!(notes.iter().any(|note| note.contains("are black")), "{notes:?}");
        assert!(shots.len() < 16, "{}", shots.len());
        let steps: Vec<f64> = shots.windows(2).map(|s| s[1].time.unwrap() - s[0].time.unwrap()).collect();
        assert!(steps.iter().any(|step| *step > 0.15) && steps.iter().any(|step| *step < 0.15), "{steps:?}");
    }

    #[test]
    fn what_is_no_video_is_refused_with_a_reason() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.mp4");
        std::fs::write(&path, b"no video at all").unwrap();
        let (choice, hooks) = (Choice::default(), Hooks::silent());
        let told = |ffmpeg: &str| {
            let mut notes = Notes::new();
            read_with(OsStr::new(ffmpeg), &source(&path), "", &choice, folder.path(), &hooks, &mut notes)
                .unwrap_err()
        };
        let Error::Refused { problem, fix } = told("no-such-ffmpeg") else { panic!("another error") };
        assert!(problem.contains("not installed") && fix.contains("apt install ffmpeg"), "{problem} {fix}");
        if Command::new("ffmpeg").arg("-version").output().is_ok() {
            let error = told("ffmpeg").to_string();
            assert!(error.contains("notes.mp4") && error.contains("no pictures"), "{error}");
            // Sound alone.
            if let Some(path) = video_of_sound(folder.path()) {
                let mut notes = Notes::new();
                let error = read(&source(&path), "", &choice, folder.path(), &hooks, &mut notes).unwrap_err();
                assert!(error.to_string().contains("sound.mp4"), "{error}");
            }
        }
    }

    fn video_of_sound(folder: &Path) -> Option<std::path::PathBuf> {
        let path = folder.join("sound.mp4");
        let made = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", "sine=duration=1"])
            .arg(&path)
            .status();
        made.ok().filter(std::process::ExitStatus::success).map(|_| path)
    }
}
