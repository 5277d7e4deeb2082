//! Frames of videos through ffmpeg: one pass looks at all of them, another writes those that are taken.

use std::ffi::OsStr;
use std::io::{self, BufReader, Read};
use std::path::Path;
use std::sync::{Mutex, PoisonError, mpsc};

use cif_dataset::orientation::Orientation;
use cif_dataset::{FrameSource, VideoFrame};
use cif_geometry::stats::upper_median;
use image::ImageEncoder;
use image::codecs::png::PngEncoder;

use super::bt2100::{Conversion, Primaries, Transfer};
use super::check::Notes;
use super::choose::{Choice, Seen, choose};
use super::ffmpeg;
use super::ffmpeg::Pass;
use super::pixmap::{self, Pixmap, Samples};
use super::shot::Shot;
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
    program: &OsStr,
    source: &Source,
    prefix: &str,
    choice: &Choice,
    folder: &Path,
    hooks: &Hooks<'_>,
    notes: &mut Notes,
) -> Result<Vec<Shot>, Error> {
    let shown = source.path.display();
    cif_input::check(&source.path).map_err(Error::io("read", &source.path))?;
    hooks.say(&format!("looking at {}", source.camera));
    let Look { mut seen, size, colors } = look(program, source, hooks)?;
    let conversion = conversion(source, &colors, notes)?;
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
    hooks.say(&format!("{} of {} frames of {}", taken.len(), seen.len(), source.camera));
    let into = folder.join(&source.camera);
    std::fs::create_dir_all(&into).map_err(Error::io("create", &into))?;
    let written = write(program, source, &taken, choice.max_side, conversion.as_ref(), &into, hooks)?;
    if written.len() < taken.len() {
        return Err(Error::refused(
            format!("{shown}: ffmpeg wrote {} of {} frames", written.len(), taken.len()),
            "check the video, as with ffmpeg -i VIDEO -f null -",
        ));
    }
    let shot = |(k, written): (&usize, (u32, u32))| {
        let name = file_name(*k);
        Shot {
            camera: source.camera.clone(),
            name: format!("{prefix}{name}"),
            file: into.join(name),
            time: Some(seen[*k].time - start),
            size: written,
            turned: Orientation::NoTransforms,
            impression: seen[*k].impression.clone(),
            source: Some(FrameSource {
                file: source.file_name(),
                size,
                video: Some(VideoFrame {
                    frame: *k as u64,
                    of: seen.len() as u64,
                    // Microseconds, as those of the capture.
                    time: ((seen[*k].time - offset) * 1e6).round() / 1e6,
                }),
            }),
        }
    };
    Ok(taken.iter().zip(written).map(shot).collect())
}

/// File of a frame by its number in the stream.
fn file_name(number: usize) -> String {
    format!("{number:06}.png")
}

/// A look at all frames of a video.
struct Look {
    seen: Vec<Seen>,
    /// Width and height as shown, pixels.
    size: [u32; 2],
    colors: Colors,
}

/// Colours of a video by the names that ffmpeg has for them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Colors {
    transfer: String,
    primaries: String,
}

/// The conversion of HLG and PQ video to display values; `None` for other video, which has them.
fn conversion(source: &Source, colors: &Colors, notes: &mut Notes) -> Result<Option<Conversion>, Error> {
    let Some(transfer) = Transfer::of(&colors.transfer) else { return Ok(None) };
    let shown = source.path.display();
    let primaries = match colors.primaries.as_str() {
        "bt2020" | "unknown" | "reserved" | "" => Primaries::Bt2020,
        "bt709" => Primaries::Bt709,
        other => {
            return Err(Error::refused(
                format!(
                    "{shown}: {} video with primaries {other}, which are not converted to those of displays",
                    transfer.name()
                ),
                "convert it to BT.709 first, as with ffmpeg -i VIDEO -vf zscale=t=linear:npl=203,tonemap=mobius,\
                 zscale=p=bt709:t=bt709:m=bt709,format=yuv420p sdr.mp4",
            ));
        }
    };
    notes.push(format!(
        "{shown}: {} video; white of 203 cd/m2 and brighter light are brought to the display values of sRGB",
        transfer.name()
    ));
    Ok(Some(Conversion::new(transfer, primaries)))
}

/// All frames of a video as they look from afar.
fn look(program: &OsStr, source: &Source, hooks: &Hooks<'_>) -> Result<Look, Error> {
    let (mut times, mut size, mut colors) = (Vec::new(), None, Colors::default());
    let filter = format!("showinfo,scale={WIDTH}:{HEIGHT}:flags=bilinear,format=gray");
    let line = |line: &str| {
        let Some((_, facts)) = line.split_once("showinfo") else { return };
        times.extend(time_of(facts));
        size = size.or_else(|| size_of(facts));
        if let (Some(transfer), true) = (fact(facts, "color_trc:"), colors.transfer.is_empty()) {
            let primaries = fact(facts, "color_primaries:").unwrap_or_default().to_owned();
            colors = Colors { transfer: transfer.to_owned(), primaries };
        }
    };
    let frames = |pipe: &mut dyn Read| {
        let mut frames = Vec::new();
        let mut grey = vec![0; WIDTH * HEIGHT];
        while fill(pipe, &mut grey)? {
            frames.push(Impression::of(&grey));
        }
        Ok(frames)
    };
    let pass = Pass { program, source, filter: &filter, output: &["-f", "rawvideo"] };
    let frames = ffmpeg::run(&pass, hooks, line, frames, |_| false)?;
    let size = size.filter(|_| !frames.is_empty() && times.len() >= frames.len()).ok_or_else(|| {
        Error::refused(
            format!("{}: the video has no frames that ffmpeg can decode", source.path.display()),
            "check that it plays, or give a folder of photographs",
        )
    })?;
    let mut seen: Vec<Seen> =
        times.into_iter().zip(frames).map(|(time, impression)| Seen { time, impression }).collect();
    // Streams now and then repeat or turn back a time; what follows is no earlier.
    for k in 1..seen.len() {
        seen[k].time = seen[k].time.max(seen[k - 1].time);
    }
    Ok(Look { seen, size, colors })
}

/// Reads a whole frame; false where the pipe ends before it does.
fn fill(pipe: &mut dyn Read, frame: &mut [u8]) -> io::Result<bool> {
    match pipe.read_exact(frame) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
        Err(error) => Err(error),
    }
}

/// A word after a key, in a line of the filter `showinfo`.
fn fact<'a>(facts: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = facts.split_once(key)?;
    rest.split_whitespace().next()
}

/// The size of a frame in a line of the filter `showinfo`.
fn size_of(facts: &str) -> Option<[u32; 2]> {
    let (width, height) = fact(facts, " s:")?.split_once('x')?;
    Some([width.parse().ok()?, height.parse().ok()?])
}

/// The time of a frame in a line of the filter `showinfo`.
fn time_of(facts: &str) -> Option<f64> {
    fact(facts, "pts_time:")?.parse().ok().filter(|time: &f64| time.is_finite())
}

/// Largest deviation of distances between frames from their median, as a share of it; `None` for less than
/// three.
fn spread_of_distances(seen: &[Seen]) -> Option<f64> {
    let mut distances: Vec<f64> = seen.windows(2).map(|pair| pair[1].time - pair[0].time).collect();
    let median = upper_median(&mut distances).filter(|_| distances.len() > 1)?;
    let (low, high) = (distances.first()?, distances.last()?);
    (median > 0.0).then(|| (high - median).max(median - low) / median)
}

/// Writes frames by their numbers, and returns the size of each, in order. All frames go through a pipe and are counted
/// there: numbers in an expression of a filter would be a term each, and ffmpeg has room for a hundred.
fn write(
    program: &OsStr,
    source: &Source,
    taken: &[usize],
    max_side: Option<u32>,
    conversion: Option<&Conversion>,
    into: &Path,
    hooks: &Hooks<'_>,
) -> Result<Vec<(u32, u32)>, Error> {
    let format = if conversion.is_some() { "format=rgb48be" } else { "format=rgb24" };
    let scale = max_side.map_or(String::new(), |side| {
        // Even sizes, as most codecs have; never larger than it is.
        format!("scale='if(gte(iw,ih),min(iw,{side}),-2)':'if(gte(iw,ih),-2,min(ih,{side}))':flags=area,")
    });
    let threads = rayon::current_num_threads();
    // Frames wait in memory for no longer than it takes to write as many as there are threads.
    let (sender, receiver) = mpsc::sync_channel::<(usize, Pixmap)>(threads);
    let receiver = Mutex::new(receiver);
    let encode = || -> Result<(), Error> {
        let mut done = Ok(());
        loop {
            let next = receiver.lock().unwrap_or_else(PoisonError::into_inner).recv();
            let Ok((number, frame)) = next else { return done };
            // After a failure frames are still taken, so that none waits for a writer.
            if done.is_ok() {
                let frame = match conversion {
                    Some(conversion) => conversion.display(frame),
                    None => frame,
                };
                done = save(&frame, &into.join(file_name(number)));
            }
        }
    };
    std::thread::scope(|scope| {
        let sender = sender;
        let frames = |pipe: &mut dyn Read| {
            let mut pipe = BufReader::new(pipe);
            let (mut sizes, mut memory) = (Vec::with_capacity(taken.len()), Vec::new());
            for number in 0.. {
                let Some(selected) = taken.get(sizes.len()) else { break };
                let Some(frame) = pixmap::next(&mut pipe, std::mem::take(&mut memory))? else { break };
                if number < *selected {
                    memory = frame.into_memory();
                    continue;
                }
                sizes.push((frame.width, frame.height));
                if sender.send((number, frame)).is_err() {
                    break;
                }
            }
            Ok(sizes)
        };
        let writers: Vec<_> = (0..threads).map(|_| scope.spawn(encode)).collect();
        let filter = format!("{scale}{format}");
        let pass = Pass { program, source, filter: &filter, output: &["-c:v", "ppm", "-f", "image2pipe"] };
        let enough = |sizes: &Vec<_>| sizes.len() == taken.len();
        let sizes = ffmpeg::run(&pass, hooks, |_| (), frames, enough);
        drop(sender);
        for writer in writers {
            writer.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        }
        sizes
    })
}

/// Writes a frame as PNG.
fn save(frame: &Pixmap, path: &Path) -> Result<(), Error> {
    let Samples::Eight(pixels) = &frame.samples else {
        return Err(Error::io("write", path)(io::Error::other("it has 16 bits")));
    };
    let file = std::fs::File::create(path).map_err(Error::io("write", path))?;
    PngEncoder::new(io::BufWriter::new(file))
        .write_image(pixels, frame.width, frame.height, image::ExtendedColorType::Rgb8)
        .map_err(|error| Error::io("write", path)(io::Error::other(error)))
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    fn source(path: &Path) -> Source {
        Source { camera: "walk".to_owned(), path: path.to_owned(), photographs: None }
    }

    /// A small test video made by ffmpeg; `None` where there is no ffmpeg.
    fn video(folder: &Path, filter: &str, name: &str) -> Option<std::path::PathBuf> {
        video_with(folder, filter, &[], name)
    }

    fn video_with(folder: &Path, filter: &str, options: &[&str], name: &str) -> Option<std::path::PathBuf> {
        let path = folder.join(name);
        let made = Command::new("ffmpeg")
            .args(["-nostdin", "-v", "error", "-f", "lavfi", "-i", filter])
            .args(options)
            .args(["-c:v", "ffv1"])
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
    fn lines_of_showinfo_give_times_and_sizes() {
        let line = "_0 @ 0x55] [info] n:   3 pts:    300 pts_time:0.3     pos:      1 sar:1/1 s:854x480 i:P";
        assert_eq!((time_of(line), size_of(line)), (Some(0.3), Some([854, 480])));
        let line = "_0 @ 0x55] [info] n:   3 pts:   NOPTS pts_time:NOPTS";
        assert_eq!((time_of(line), size_of(line)), (None, None));
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

    /// A video of 20 s whose frames show their numbers: two patches with its digits to the base of 16.
    const COUNTED: &str = "color=gray:size=48x32:rate=15:duration=20,format=gray,\
        geq=lum='if(lt(X,16),40+11*mod(N,16),if(lt(X,32),40+11*floor(N/16),60+100*mod(floor(Y/4),2)))'";

    fn number_in(path: &Path) -> usize {
        let picture = image::open(path).unwrap().into_luma8();
        // Neighbouring digits are 11 apart, whatever range the values are in.
        let digit = |x: u32| ((f64::from(picture.get_pixel(x, 16).0[0]) - 40.0) / 11.0).round() as usize;
        digit(8) + 16 * digit(24)
    }

    #[test]
    fn a_long_video_gives_the_frames_that_were_chosen() {
        let folder = tempfile::tempdir().unwrap();
        let Some(path) = video(folder.path(), COUNTED, "walk.mkv") else { return };
        // More single frames than an expression of ffmpeg has room for.
        let (mut notes, hooks) = (Notes::new(), Hooks::silent());
        let shots = read(&source(&path), "", &Choice::default(), folder.path(), &hooks, &mut notes).unwrap();
        assert_eq!(shots.len(), 150);
        for (k, shot) in shots.iter().enumerate() {
            let number = number_in(&shot.file);
            assert_eq!(shot.name, format!("{number:06}.png"));
            assert!((2 * k..2 * k + 2).contains(&number), "{number} of window {k}");
            let source = shot.source.as_ref().unwrap();
            assert_eq!((source.file.as_str(), source.size), ("walk.mkv", [48, 32]));
            let place = source.video.unwrap();
            assert_eq!((place.frame, place.of), (number as u64, 300));
            assert!((place.time - number as f64 / 15.0).abs() < 2e-3, "{place:?}");
        }
    }

    #[test]
    fn hlg_and_pq_become_display_values() {
        // Grey card and white paper (BT.2408-7, table 1) side by side, as signals of both kinds.
        let signals = |card: f64, white: f64| {
            format!(
                "color=gray:size=96x64:rate=10:duration=0.5,format=yuv444p10le,geq=cb=512:cr=512:\
                 lum='64+876*if(lt(X,48),{card},{white})'"
            )
        };
        let folder = tempfile::tempdir().unwrap();
        let (choice, hooks) = (Choice::default(), Hooks::silent());
        for (transfer, name, signals) in
            [("arib-std-b67", "HLG", signals(0.38, 0.75)), ("smpte2084", "PQ", signals(0.381, 0.5807))]
        {
            let tags = ["-color_range", "tv", "-color_primaries", "bt2020", "-colorspace", "bt2020nc"];
            let tags: Vec<&str> = tags.into_iter().chain(["-color_trc", transfer]).collect();
            let Some(path) = video_with(folder.path(), &signals, &tags, &format!("{name}.mkv")) else {
                return;
            };
            let (mut notes, into) = (Notes::new(), folder.path().join(name));
            let shots = read(&source(&path), "", &choice, &into, &hooks, &mut notes).unwrap();
            assert!(notes.iter().any(|note| note.contains(name) && note.contains("sRGB")), "{notes:?}");
            let picture = image::open(&shots[0].file).unwrap().into_rgb8();
            // 26 cd/m2 are 0.128 of white, 101 of 255; white paper is bent to 0.79 of white.
            let (card, white) = (picture.get_pixel(20, 30).0, picture.get_pixel(70, 30).0);
            assert!(card.iter().all(|value| value.abs_diff(101) <= 2), "{name}: {card:?}");
            assert!(white.iter().all(|value| value.abs_diff(229) <= 3), "{name}: {white:?}");
        }
        let tags = ["-color_primaries", "smpte432", "-color_trc", "arib-std-b67"];
        let Some(path) = video_with(folder.path(), &signals(0.38, 0.75), &tags, "p3.mkv") else { return };
        let message =
            read(&source(&path), "", &choice, folder.path(), &hooks, &mut Notes::new()).unwrap_err();
        let message = message.to_string();
        assert!(message.contains("HLG") && message.contains("smpte432"), "{message}");
    }

    #[cfg(unix)]
    #[test]
    fn the_first_errors_of_ffmpeg_are_shown_and_old_versions_are_served() {
        use std::os::unix::fs::PermissionsExt;

        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("walk.mp4");
        std::fs::write(&path, b"x").unwrap();
        let stand_in = |script: &str| {
            let program = folder.path().join("stand-in");
            std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
            std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
            let (choice, hooks) = (Choice::default(), Hooks::silent());
            read_with(
                program.as_os_str(),
                &source(&path),
                "",
                &choice,
                folder.path(),
                &hooks,
                &mut Notes::new(),
            )
        };
        let message = stand_in(
            "echo '[Parsed_x @ 0x1] [error] No space for terms' >&2; echo '[info] Conversion failed!' >&2; exit 1",
        );
        let message = message.unwrap_err().to_string();
        assert!(message.ends_with("ffmpeg fails: No space for terms"), "{message}");
        // One that does not know -fps_mode, and gives no frames.
        let message = stand_in(
            "case \"$*\" in *-fps_mode*) echo \"[error] Unrecognized option 'fps_mode'.\" >&2; exit 1;; esac",
        );
        assert!(message.unwrap_err().to_string().contains("no frames that ffmpeg can decode"));
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
    fn variable_rates_and_black_frames_are_reported() {
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
        let message = |ffmpeg: &str| {
            let mut notes = Notes::new();
            read_with(OsStr::new(ffmpeg), &source(&path), "", &choice, folder.path(), &hooks, &mut notes)
                .unwrap_err()
        };
        let Error::System(cif_system::Error::Refused { problem, fix }) = message("no-such-ffmpeg") else {
            panic!("another error")
        };
        assert!(problem.contains("not installed") && fix.contains("apt install ffmpeg"), "{problem} {fix}");
        if Command::new("ffmpeg").arg("-version").output().is_ok() {
            let error = message("ffmpeg").to_string();
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
