//! The folder of models: `models.toml` names files, inputs and outputs.
//!
//! ```toml
#![doc = include_str!("models.toml")]
//! ```

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use serde::Deserialize;
use xxhash_rust::xxh3::Xxh3;

use crate::Error;

/// Name of the file that describes a folder of models.
pub const MANIFEST: &str = "models.toml";

/// A manifest with every part, explained.
pub const EXAMPLE: &str = include_str!("models.toml");

/// Longest manifest, bytes.
const MAX_MANIFEST: u64 = 1 << 20;

/// A folder of models, whose files are there.
#[derive(Clone, Debug)]
pub struct Models {
    folder: PathBuf,
    text: String,
    content: Content,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    detector: Option<Network>,
    segmenter: Option<Segmenter>,
    embedder: Option<Embedder>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Segmenter {
    encoder: Network,
    decoder: Network,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Embedder {
    name: String,
    #[serde(default = "clip_size")]
    size: u32,
    image: Network,
    text: Network,
}

fn clip_size() -> u32 {
    224
}

/// One model file, with the names of its tensors by part.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Network {
    /// The ONNX file.
    pub(crate) model: PathBuf,
    /// The file `tokenizer.json`, for models that read text.
    pub(crate) tokenizer: Option<PathBuf>,
    /// Names of inputs by part.
    pub(crate) inputs: BTreeMap<String, String>,
    /// Names of outputs by part.
    pub(crate) outputs: BTreeMap<String, String>,
}

impl Network {
    fn files(&self) -> impl Iterator<Item = &PathBuf> {
        std::iter::once(&self.model).chain(&self.tokenizer)
    }

    /// The tokenizer's file.
    ///
    /// # Errors
    /// Where `models.toml` names none.
    pub(crate) fn tokenizer(&self) -> Result<&Path, Error> {
        self.tokenizer.as_deref().ok_or_else(|| {
            Error::refused(
                format!("{MANIFEST} names no tokenizer for {}, which reads text", self.model.display()),
                "add tokenizer = \"tokenizer.json\" with the name of its file",
            )
        })
    }
}

impl Models {
    /// Reads the manifest of a folder, and looks for the files that it names.
    ///
    /// # Errors
    /// When there is no such folder or manifest, it does not say what it has to, or a file is missing.
    pub fn open(folder: &Path) -> Result<Self, Error> {
        let path = folder.join(MANIFEST);
        if !path.exists() {
            return Err(Error::refused(
                format!("{} has no {MANIFEST}, which names models and their tensors", folder.display()),
                "give a folder of ONNX models; cif query --help shows such a file",
            ));
        }
        let size = cif_input::check(&path).map_err(Error::io("read", &path))?;
        if size > MAX_MANIFEST {
            return Err(Error::refused(
                format!("{} has {size} bytes, too many for a list of models", path.display()),
                format!("write one of at most {MAX_MANIFEST}"),
            ));
        }
        let text = cif_input::read_to_string(&path).map_err(Error::io("read", &path))?;
        let mut content: Content = toml::from_str(&text).map_err(|error| {
            Error::refused(
                format!("{}: {}", path.display(), error.to_string().trim_end()),
                "cif query --help shows such a file",
            )
        })?;
        for network in content.networks_mut() {
            network.model = folder.join(&network.model);
            network.tokenizer = network.tokenizer.as_ref().map(|file| folder.join(file));
        }
        for file in content.networks().flat_map(Network::files) {
            cif_input::check(file).map_err(|error| {
                Error::refused(
                    format!("{} names the file {}: {error}", path.display(), file.display()),
                    "put it there, or correct the name; nothing is downloaded",
                )
            })?;
        }
        Ok(Self { folder: folder.to_owned(), text, content })
    }

    /// The folder.
    #[must_use]
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Name of the models that make embeddings.
    ///
    /// # Errors
    /// When the folder has none.
    pub fn embedder_name(&self) -> Result<&str, Error> {
        self.embedder().map(|(name, ..)| name)
    }

    pub(crate) fn detector(&self) -> Result<&Network, Error> {
        self.content.detector.as_ref().ok_or_else(|| self.missing("detector", "finds boxes of a prompt"))
    }

    /// Encoder and decoder.
    pub(crate) fn segmenter(&self) -> Result<(&Network, &Network), Error> {
        let found = self.content.segmenter.as_ref().map(|segmenter| (&segmenter.encoder, &segmenter.decoder));
        found.ok_or_else(|| self.missing("segmenter", "makes masks of boxes"))
    }

    /// Name of the embeddings, side of its pictures in pixels, and the models of pictures and of texts.
    pub(crate) fn embedder(&self) -> Result<(&str, u32, &Network, &Network), Error> {
        match &self.content.embedder {
            Some(Embedder { name, size, image, text }) => {
                if name.trim().is_empty() || !(1..=4096).contains(size) {
                    return Err(Error::refused(
                        format!("[embedder] of {} needs a name, and a size of 1 to 4096", self.manifest()),
                        "for example name = \"clip-vit-base-patch32\" and size = 224",
                    ));
                }
                Ok((name, *size, image, text))
            }
            None => Err(self.missing("embedder", "compares pictures with texts")),
        }
    }

    fn manifest(&self) -> String {
        self.folder.join(MANIFEST).display().to_string()
    }

    fn missing(&self, table: &str, purpose: &str) -> Error {
        Error::refused(
            format!("{} has no [{table}], which {purpose}", self.manifest()),
            "add the model and its tensors; cif query --help shows such a file",
        )
    }

    /// A number that changes with the manifest and with names, sizes and dates of the files that detector and segmenter
    /// are made of, their external data included.
    ///
    /// # Errors
    /// When a file is gone.
    pub fn stamp(&self) -> Result<u128, Error> {
        let mut hash = Xxh3::new();
        hash.update(self.text.as_bytes());
        let segmenter = self.content.segmenter.iter().flat_map(|one| [&one.encoder, &one.decoder]);
        let networks = self.content.detector.iter().chain(segmenter);
        for file in networks.flat_map(Network::files).flat_map(|file| with_data(file)) {
            let about = std::fs::metadata(&file).map_err(Error::io("read", &file))?;
            let age = about.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
            hash.update(file.as_os_str().as_encoded_bytes());
            hash.update(&about.len().to_le_bytes());
            hash.update(&age.map_or(0, |age| age.as_nanos()).to_le_bytes());
        }
        Ok(hash.digest128())
    }
}

/// A file and those next to it whose names begin with its own, as external data of ONNX models have it, in order.
fn with_data(file: &Path) -> Vec<PathBuf> {
    let name = file.file_name().unwrap_or_default().as_encoded_bytes();
    let mut files = vec![file.to_owned()];
    let siblings = file.parent().and_then(|folder| std::fs::read_dir(folder).ok());
    files.extend(siblings.into_iter().flatten().flatten().map(|entry| entry.path()).filter(|path| {
        let other = path.file_name().unwrap_or_default().as_encoded_bytes();
        other.len() > name.len() && other.starts_with(name)
    }));
    files.sort();
    files
}

impl Content {
    fn networks(&self) -> impl Iterator<Item = &Network> {
        let segmenter = self.segmenter.iter().flat_map(|one| [&one.encoder, &one.decoder]);
        let embedder = self.embedder.iter().flat_map(|one| [&one.image, &one.text]);
        self.detector.iter().chain(segmenter).chain(embedder)
    }

    fn networks_mut(&mut self) -> impl Iterator<Item = &mut Network> {
        let segmenter = self.segmenter.iter_mut().flat_map(|one| [&mut one.encoder, &mut one.decoder]);
        let embedder = self.embedder.iter_mut().flat_map(|one| [&mut one.image, &mut one.text]);
        self.detector.iter_mut().chain(segmenter).chain(embedder)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DETECTOR: &str = "[detector]\nmodel = \"d.onnx\"\ntokenizer = \"t.json\"\n\
                            inputs = { image = \"i\" }\noutputs = { logits = \"l\", boxes = \"b\" }\n";

    fn folder(manifest: &str, files: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(MANIFEST), manifest).unwrap();
        for file in files {
            std::fs::write(folder.path().join(file), file).unwrap();
        }
        folder
    }

    fn problem(folder: &Path) -> String {
        Models::open(folder).unwrap_err().to_string()
    }

    #[test]
    fn what_is_missing_is_named() {
        let empty = tempfile::tempdir().unwrap();
        assert!(problem(empty.path()).contains("no models.toml"));
        assert!(problem(folder(DETECTOR, &["t.json"]).path()).contains("d.onnx"));
        let unknown = DETECTOR.replace("tokenizer", "tokeniser");
        let message = problem(folder(&unknown, &["d.onnx", "t.json"]).path());
        assert!(message.contains("tokeniser") && message.contains("line 3"), "{message}");
        let models = folder(DETECTOR, &["d.onnx", "t.json"]);
        let models = Models::open(models.path()).unwrap();
        assert_eq!(models.detector().unwrap().outputs["boxes"], "b");
        assert!(models.segmenter().unwrap_err().to_string().contains("no [segmenter]"));
        assert!(models.embedder_name().unwrap_err().to_string().contains("no [embedder]"));
    }

    #[test]
    fn the_example_says_what_has_to_be_said() {
        let content: Content = toml::from_str(EXAMPLE).unwrap();
        assert_eq!(content.networks().count(), 5);
        assert_eq!(content.segmenter.unwrap().decoder.inputs["has_previous"], "has_mask_input");
    }

    #[test]
    fn stamps_change_with_what_models_are_made_of() {
        let place = folder(DETECTOR, &["d.onnx", "t.json"]);
        let stamp = || Models::open(place.path()).unwrap().stamp().unwrap();
        let first = stamp();
        assert_eq!(stamp(), first);
        std::fs::write(place.path().join("notes.txt"), "of no model").unwrap();
        assert_eq!(stamp(), first);
        std::fs::write(place.path().join("d.onnx_data"), "weights").unwrap();
        let with_data = stamp();
        assert_ne!(with_data, first);
        std::fs::write(place.path().join("t.json"), "longer than before").unwrap();
        assert_ne!(stamp(), with_data);
    }
}
