//! The server of a page: for this machine, and for those who know the address.

use std::net::{Ipv4Addr, SocketAddr};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use cif_web::Page;
use tiny_http::{Header, Method, Request, Response};

use super::images::Images;
use super::shown::Shown;
use crate::error::Error;
use crate::messages::warning;

/// Threads that answer: as many as browsers ask at a time for images of one page.
const THREADS: usize = 6;

/// Time after which a thread looks whether it shall stop.
const PATIENCE: Duration = Duration::from_millis(150);

/// Time without a question after which nobody looks any more: pages ask once a second.
const WATCHED: Duration = Duration::from_secs(5);

/// A page and its data at an address of its own.
pub(in crate::commands) struct Server {
    http: tiny_http::Server,
    port: u16,
    /// What must begin every path: nobody guesses it, and pages of other origins do not know it.
    token: String,
    content: Content,
}

/// All that the server answers with.
struct Content {
    page: cif_web::assets::Html,
    scene: Mutex<Scene>,
    images: Option<Images>,
    /// True after the page has asked to stop what it watches.
    is_stopped: AtomicBool,
    /// When a page has asked last how far the run is.
    asked: Mutex<Option<Instant>>,
}

/// What a page shows now.
struct Scene {
    document: Vec<u8>,
    bytes: Vec<u8>,
    /// How far a run is that the page watches; `None` where the scene stays as it is.
    status: Option<Vec<u8>>,
}

/// An answer: status, kind of content and bytes.
type Answer = (u16, &'static str, Vec<u8>);

impl Server {
    /// Starts at a port, 0 for any.
    ///
    /// # Errors
    /// When the port is taken.
    pub(in crate::commands) fn start(shown: Shown, port: u16) -> Result<Self, Error> {
        let http = tiny_http::Server::http((Ipv4Addr::LOCALHOST, port)).map_err(|error| {
            Error::failed(
                format!("no page can be served at port {port} of this machine: {error}"),
                "leave --port out, or name one that is free",
            )
        })?;
        let port = http.server_addr().to_ip().as_ref().map_or(port, SocketAddr::port);
        let token = format!("{:032x}", rand::random::<u128>());
        let (page, images) = shown.into_parts();
        let content = Content {
            page: cif_web::assets::html(&page.document.title, ""),
            scene: Mutex::new(Scene {
                document: serde_json::to_vec(&page.document).map_err(Error::plain)?,
                bytes: page.bytes,
                status: None,
            }),
            images,
            is_stopped: AtomicBool::new(false),
            asked: Mutex::new(None),
        };
        Ok(Self { http, port, token, content })
    }

    /// The address of the page.
    pub(in crate::commands) fn address(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.port, self.token)
    }

    /// Shows another state of the scene, at the next status that says so.
    ///
    /// # Errors
    /// None but those of JSON, which documents do not have.
    pub(in crate::commands) fn show(&self, page: Page) -> Result<(), Error> {
        let document = serde_json::to_vec(&page.document).map_err(Error::plain)?;
        let mut scene = self.content.scene();
        (scene.document, scene.bytes) = (document, page.bytes);
        Ok(())
    }

    /// Sets how far the run is that the page watches, JSON.
    pub(in crate::commands) fn set_status(&self, status: Vec<u8>) {
        self.content.scene().status = Some(status);
    }

    /// True after the page has asked to stop.
    pub(in crate::commands) fn is_stopped(&self) -> bool {
        self.content.is_stopped.load(Ordering::Relaxed)
    }

    /// True while a page asks how far the run is.
    pub(in crate::commands) fn is_watched(&self) -> bool {
        let asked = *self.content.asked.lock().unwrap_or_else(PoisonError::into_inner);
        asked.is_some_and(|asked| asked.elapsed() < WATCHED)
    }

    /// Answers until it `is_over`.
    pub(in crate::commands) fn serve(&self, is_over: impl Fn() -> bool + Sync) {
        std::thread::scope(|scope| {
            for _ in 0..THREADS {
                scope.spawn(|| {
                    while !is_over() {
                        if let Ok(Some(request)) = self.http.recv_timeout(PATIENCE) {
                            self.answer(request);
                        }
                    }
                });
            }
        });
    }

    fn answer(&self, request: Request) {
        let host = request.headers().iter().find(|header| header.field.equiv("Host"));
        let host = host.map(|header| header.value.as_str().to_owned()).unwrap_or_default();
        let (status, kind, body) = self.respond(request.method(), request.url(), &host);
        let mut response =
            Response::from_data(body).with_status_code(status).with_chunked_threshold(usize::MAX);
        for header in self.headers(kind, status) {
            response.add_header(header);
        }
        // A browser that has left needs no answer.
        drop(request.respond(response));
    }

    /// The answer to a request. Names of other hosts are refused, by which pages of others would reach this one (DNS
    /// rebinding).
    fn respond(&self, method: &Method, url: &str, host: &str) -> Answer {
        let known = [format!("127.0.0.1:{}", self.port), format!("localhost:{}", self.port)];
        if !known.iter().any(|name| name == host) {
            return text(403, "this page is for this machine alone");
        }
        let path = url.split(['?', '#']).next().unwrap_or_default();
        let inside = path.strip_prefix('/').and_then(|path| path.strip_prefix(self.token.as_str()));
        let Some(inside) = inside.and_then(|path| path.strip_prefix('/')) else {
            return text(403, "the address is not complete: take the one that cif view printed");
        };
        if *method == Method::Post && inside == "stop" && self.content.scene().status.is_some() {
            self.content.is_stopped.store(true, Ordering::Relaxed);
            return text(200, "the run stops and saves");
        }
        if !matches!(method, Method::Get | Method::Head) {
            return text(405, "nothing is written here");
        }
        match inside {
            "" => (200, "text/html; charset=utf-8", self.content.page.text.clone().into_bytes()),
            "scene.json" => (200, "application/json", self.content.scene().document.clone()),
            "scene.bin" => (200, "application/octet-stream", self.content.scene().bytes.clone()),
            "status.json" => {
                *self.content.asked.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
                match &self.content.scene().status {
                    Some(status) => (200, "application/json", status.clone()),
                    None => text(404, "nothing goes on here"),
                }
            }
            address => match self.content.images.as_ref().and_then(|images| images.at(address)) {
                Some(Ok(picture)) => (200, "image/png", picture),
                Some(Err(error)) => {
                    warning!("{error}");
                    text(500, "the image cannot be read; cif view says why")
                }
                None => text(404, "there is nothing of that name"),
            },
        }
    }

    fn headers(&self, kind: &str, status: u16) -> Vec<Header> {
        // Images of a running page stay as they are.
        let cache = if kind == "image/png" { "private, max-age=3600" } else { "no-store" };
        let policy = format!("{}; frame-ancestors 'none'", self.content.page.policy);
        let pairs = [
            ("Content-Type", kind),
            ("Cache-Control", if status == 200 { cache } else { "no-store" }),
            ("Content-Security-Policy", &policy),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cross-Origin-Opener-Policy", "same-origin"),
        ];
        pairs.iter().filter_map(|(name, value)| Header::from_bytes(*name, *value).ok()).collect()
    }
}

impl Content {
    fn scene(&self) -> MutexGuard<'_, Scene> {
        self.scene.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn text(status: u16, message: &str) -> Answer {
    (status, "text/plain; charset=utf-8", format!("{message}\n").into_bytes())
}
