//! `cif view` and `cif train --view`: what they serve, and whom they answer.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use cif_render::synthetic::{SyntheticConfig, generate};
use serde_json::Value;

const CIF: &str = env!("CARGO_BIN_EXE_cif-under-test");
const CAPTURE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/tabletop-mini");

/// A command that serves a page, ended with the test.
struct Served {
    child: Child,
    host: String,
    token: String,
}

impl Served {
    /// Starts a command, and takes the address of its page from the lines that it writes.
    fn start(folder: &Path, arguments: &[&str], from_errors: bool) -> Self {
        let mut child = Command::new(CIF)
            .args(arguments)
            .current_dir(folder)
            .stdout(Stdio::piped())
            .stderr(if from_errors { Stdio::piped() } else { Stdio::inherit() })
            .spawn()
            .expect("the command starts");
        let mut lines: Box<dyn BufRead + Send> = match from_errors {
            true => Box::new(BufReader::new(child.stderr.take().expect("a pipe"))),
            false => Box::new(BufReader::new(child.stdout.take().expect("a pipe"))),
        };
        let mut line = String::new();
        while !line.contains("http://") {
            line.clear();
            assert!(lines.read_line(&mut line).expect("a pipe") > 0, "it ended without an address");
        }
        // What else it says does not fill the pipe.
        std::thread::spawn(move || std::io::copy(&mut lines, &mut std::io::sink()));
        let address = line[line.find("http://").expect("just looked") + 7..].trim();
        let (host, token) = address.split_once('/').expect("a path");
        Self { child, host: host.to_owned(), token: token.trim_end_matches('/').to_owned() }
    }

    /// Status, headers in lower case, and body of an answer.
    fn ask(&self, method: &str, path: &str, host: &str) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.host).expect("the server listens");
        let request = format!(
            "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).expect("the server reads");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("the server answers");
        let end = answer.windows(4).position(|window| window == b"\r\n\r\n").expect("an end of headers");
        let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
        let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).expect("a status");
        (status, head, answer.split_off(end + 4))
    }

    /// The body at an address of the page, which is there.
    fn get(&self, name: &str) -> Vec<u8> {
        let (status, _, body) = self.ask("GET", &format!("/{}/{name}", self.token), &self.host);
        assert_eq!(status, 200, "{name}: {}", String::from_utf8_lossy(&body));
        body
    }

    fn json(&self, name: &str) -> Value {
        serde_json::from_slice(&self.get(name)).expect("JSON")
    }

    /// Waits until the command has ended; its exit code.
    fn ended(&mut self) -> Option<i32> {
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(60) {
            if let Some(status) = self.child.try_wait().expect("a child") {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("it goes on");
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

/// A scene of a synthetic field, `scene.cif` in a folder.
fn scene(folder: &Path) {
    let config = SyntheticConfig { gaussians: 40, instances: 2, ..SyntheticConfig::default() };
    generate(&config).field.save(folder.join("scene.cif")).expect("the folder can be written");
}

#[test]
fn a_page_is_for_this_machine_and_for_those_who_know_its_address() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    scene(folder.path());
    let mut page = Served::start(folder.path(), &["view", "scene.cif", "--no-open"], false);
    assert!(page.host.starts_with("127.0.0.1:") && page.token.len() == 32, "{} {}", page.host, page.token);
    let root = format!("/{}/", page.token);

    let (status, head, body) = page.ask("GET", &root, &page.host);
    assert_eq!(status, 200);
    for header in
        ["default-src 'none'", "connect-src 'self'", "frame-ancestors 'none'", "nosniff", "no-referrer"]
    {
        assert!(head.contains(header), "{header} is not in {head}");
    }
    assert!(!head.contains("access-control-allow-origin"), "{head}");
    assert!(String::from_utf8_lossy(&body).contains("<title>scene.cif</title>"));

    let document = page.json("scene.json");
    let bytes = page.get("scene.bin").len();
    let splats = &document["nodes"][0]["splats"];
    assert!(splats["count"].as_u64() > Some(0));
    let end = splats["centres"]["at"].as_u64().zip(splats["centres"]["length"].as_u64());
    assert!(end.is_some_and(|(at, length)| (at + 4 * length) as usize <= bytes), "{splats}");
    assert_eq!(document["stage"], "scene.usda");

    let port = page.host.rsplit(':').next().expect("a port");
    for (method, path, host, expected) in [
        ("GET", "/", page.host.as_str(), 403),
        ("GET", "/00000000000000000000000000000000/", page.host.as_str(), 403),
        ("GET", "/favicon.ico", page.host.as_str(), 403),
        ("GET", root.as_str(), "evil.example", 403),
        ("GET", root.as_str(), &format!("evil.example:{port}"), 403),
        ("GET", root.as_str(), &format!("localhost:{port}"), 200),
        ("POST", root.as_str(), page.host.as_str(), 405),
        ("PUT", root.as_str(), page.host.as_str(), 405),
        ("POST", &format!("{root}stop"), page.host.as_str(), 405),
        ("GET", &format!("{root}status.json"), page.host.as_str(), 404),
        ("GET", &format!("{root}images/0.png"), page.host.as_str(), 404),
        ("GET", &format!("{root}../../etc/passwd"), page.host.as_str(), 404),
    ] {
        assert_eq!(page.ask(method, path, host).0, expected, "{method} {path} of {host}");
    }
    #[cfg(unix)]
    {
        let id = page.child.id().to_string();
        assert!(Command::new("kill").args(["-INT", &id]).status().is_ok_and(|status| status.success()));
        assert_eq!(page.ended(), Some(0), "Ctrl-C is how a page ends");
    }
}

#[test]
fn captures_are_looked_at_before_anything_is_trained() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let page = Served::start(folder.path(), &["view", CAPTURE, "--no-open"], false);
    let document = page.json("scene.json");
    assert_eq!(document["nodes"][0]["kind"], "points");
    assert!(document["nodes"][0]["splats"]["count"].as_u64() > Some(100));
    let views = document["views"].as_array().expect("views");
    let view = &views[5];
    let picture =
        image::load_from_memory(&page.get(view["image"].as_str().expect("an address"))).expect("PNG");
    assert_eq!(u64::from(picture.width()), view["size"][0].as_u64().expect("a width"));
    let mask = image::load_from_memory(&page.get(view["mask"].as_str().expect("an address")))
        .expect("PNG")
        .into_rgba8();
    let clear = mask.pixels().filter(|pixel| pixel.0[3] == 0).count();
    assert!(clear > 0 && clear < mask.pixels().count(), "some of the image is labelled");
    assert_eq!(page.ask("GET", &format!("/{}/images/{}.png", page.token, views.len()), &page.host).0, 404);
}

#[test]
fn scenes_are_compared_with_their_captures_alone() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    scene(folder.path());
    let page = Served::start(folder.path(), &["view", "scene.cif", "--capture", CAPTURE, "--no-open"], false);
    assert!(page.json("scene.json")["views"].as_array().is_some_and(|views| !views.is_empty()));
    let refused = |arguments: &[&str], why: &str| {
        let output = Command::new(CIF)
            .args(arguments)
            .current_dir(folder.path())
            .output()
            .expect("the command starts");
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && stderr.contains(why), "{stderr}");
    };
    refused(&["view", CAPTURE, "--capture", CAPTURE, "--no-open"], "compares with a scene");
    refused(&["view", "nothing.cif", "--no-open"], "nothing.cif");
    refused(&["view", "scene.txt", "--no-open"], "this ending is not known");
    let port = page.host.rsplit(':').next().expect("a port").to_owned();
    refused(&["view", "scene.cif", "--no-open", "--port", &port], "name one that is free");
}

#[test]
fn a_run_is_watched_and_stopped_from_its_page() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let line = [
        "train",
        CAPTURE,
        "-o",
        "run.cif",
        "--preset",
        "draft",
        "--view=address",
        "--set",
        "stages.coarse=20000",
        "--set",
        "report.step_every=5",
    ];
    let mut page = Served::start(folder.path(), &line, true);
    let status = page.json("status.json");
    assert_eq!(status["state"], "running");
    let start = Instant::now();
    let shown = loop {
        let status = page.json("status.json");
        if status["revision"].as_u64() > Some(0) && status["psnr"].is_f64() {
            break status;
        }
        assert!(start.elapsed() < Duration::from_secs(180), "nothing is shown: {status}");
        std::thread::sleep(Duration::from_millis(100));
    };
    assert_eq!(shown["phase"], "coarse");
    assert!(
        shown["psnr"].as_f64().is_some_and(|psnr| psnr > 5.0) && shown["done"].as_u64() > Some(0),
        "{shown}"
    );
    assert!(!shown["curve"].as_array().expect("a curve").is_empty());
    let document = page.json("scene.json");
    assert_eq!(document["live"], true);
    assert!(document["nodes"][0]["splats"]["count"].as_u64() > Some(100));
    assert_eq!(page.ask("POST", &format!("/{}/stop", page.token), &page.host).0, 200);
    assert_eq!(page.ended(), Some(0), "a run that is stopped on purpose has not failed");
    assert!(folder.path().join("run.cif").exists());
    let resumed = Command::new(CIF)
        .args(["train", CAPTURE, "-o", "run.cif", "--resume", "--stop-after", "5"])
        .current_dir(folder.path())
        .output()
        .expect("the command starts");
    assert!(resumed.status.success(), "{}", String::from_utf8_lossy(&resumed.stderr));
}

#[test]
fn films_are_made_of_views_by_ffmpeg() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    scene(folder.path());
    let run = |arguments: &[&str]| {
        let output = Command::new(CIF)
            .args(arguments)
            .current_dir(folder.path())
            .output()
            .expect("the command starts");
        (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let views = r#"[{ "width": 33, "height": 24, "vertical_fov_deg": 45, "position": [0, -3, 1], "look_at": [0, 0, 0],
        "up": [0, 0, 1] }]"#;
    std::fs::write(folder.path().join("views.json"), views).expect("the folder can be written");
    for (what, fps, output, why) in [
        ("rgb,depth", "24", "a.mp4", "a film shows one layer"),
        ("rgb", "24", "folder", "--fps is about a film"),
        ("rgb", "0", "a.mp4", "above 0"),
    ] {
        let line =
            ["render", "scene.cif", "--camera", "views.json", "--what", what, "--fps", fps, "-o", output];
        let (succeeded, message) = run(&line);
        assert!(!succeeded && message.contains(why), "{message}");
        assert!(!folder.path().join(output).exists());
    }
    if Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("skipped: there is no ffmpeg");
        return;
    }
    for film in ["a.mp4", "a.gif", "a.webm"] {
        let line = ["render", "scene.cif", "--camera", "views.json", "--backend", "cpu", "-o", film];
        let (succeeded, message) = run(&line);
        assert!(succeeded, "{message}");
        let (succeeded, message) = run(&line);
        assert!(!succeeded && message.contains("--force"), "{message}");
    }
    let decoded = folder.path().join("frame.png");
    let status = Command::new("ffmpeg")
        .args(["-v", "error", "-i", "a.mp4", "frame.png"])
        .current_dir(folder.path())
        .status()
        .expect("ffmpeg starts");
    assert!(status.success());
    let size = image::image_dimensions(decoded).expect("a picture");
    assert_eq!(size, (32, 24), "players want even sides");
    let left: Vec<_> = std::fs::read_dir(folder.path())
        .expect("the folder")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("a name"))
        .filter(|name| name.starts_with('.'))
        .collect();
    assert!(left.is_empty(), "{left:?}");
}
