//! Number of prims of a stage, counted from the specs of its layers before anything is composed: references,
//! payloads, inherits and instances may repeat prims that hold such arcs themselves, so that a few lines make
//! billions.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::rc::Rc;

/// Most prims of a stage that is opened. usd-core takes some 40 us and 1 KB for each that it composes.
pub(crate) const MAX_PRIMS: u64 = 250_000;

/// Deepest nesting of prims, a reference counted like a level. usd-core follows both by calling itself, which takes
/// up to 2 KB of stack a level, and threads have 2 MB; stages of people have a few dozen levels.
pub(crate) const MAX_LEVELS: u32 = 500;

/// A reference, payload, inherit or specialise.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Arc {
    /// Asset as written; empty for the same layer stack.
    pub(super) asset: String,
    /// Path of the prim; empty for the default prim.
    pub(super) prim: String,
}

/// Prim spec of a layer, or of a variant in it.
#[derive(Clone, Debug, Default)]
pub(super) struct PrimSpec {
    /// Paths of the prims directly below.
    pub(super) children: Vec<String>,
    /// Paths of the variants of every variant set, of which one is chosen.
    pub(super) variants: BTreeMap<String, Vec<String>>,
    pub(super) arcs: Vec<Arc>,
    pub(super) instanceable: Option<bool>,
    pub(super) active: Option<bool>,
}

/// Prim specs, default prim and sublayers of a layer.
#[derive(Clone, Debug, Default)]
pub(super) struct LayerSpec {
    /// By path; the root is `/`.
    pub(super) prims: HashMap<String, PrimSpec>,
    /// Path of the default prim; empty without one.
    pub(super) default_prim: String,
    /// Sublayers as written, strongest first.
    pub(super) sublayers: Vec<String>,
    /// Key of the layer that an asset is.
    pub(super) targets: BTreeMap<String, String>,
}

/// Counting of the prims of instances.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Instances {
    /// Their prims once, as usd-core composes them.
    Once,
    /// Their prims each time, as those see them who look into instances.
    Each,
}

/// Size of an expanded stage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Expansion {
    /// Prims in the layers.
    pub(super) written: u64,
    /// Prims of the stage, about: opinions about what an arc brings in count as prims of their own.
    pub(super) prims: u64,
    /// Depth of the nesting, arcs included.
    pub(super) levels: u32,
    /// The prim below the root that brings in most, and how many.
    pub(super) largest: Option<(String, u64)>,
}

/// Counts the prims of the stage whose root layer is `root`.
pub(super) fn expand(layers: &BTreeMap<String, LayerSpec>, root: &str, instances: Instances) -> Expansion {
    let mut counting =
        Counting { layers, instances, stacks: Vec::new(), known: HashMap::new(), prototypes: Vec::new() };
    let stack = counting.stack(root);
    let top = Place { stack, path: "/".to_owned() };
    let whole = counting.size(top.clone());
    let mut largest: Option<(String, u64)> = None;
    for child in counting.merged(&top).children {
        let size = counting.size(Place { stack, path: child.clone() }).prims;
        if largest.as_ref().is_none_or(|(_, most)| size > *most) {
            largest = Some((child, size));
        }
    }
    let (mut prims, mut levels) = (whole.prims - 1, whole.levels);
    let mut composed = BTreeSet::new();
    while let Some(place) = counting.prototypes.pop() {
        if composed.insert((place.stack, place.path.clone())) {
            let size = counting.size(place);
            prims = prims.saturating_add(size.prims - 1);
            levels = levels.max(size.levels);
        }
    }
    let is_prim = |path: &&String| *path != "/" && !path.ends_with('}');
    let written = layers.values().map(|layer| layer.prims.keys().filter(is_prim).count() as u64).sum();
    Expansion { written, prims, levels, largest }
}

/// A prim in a stack of layers.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Place {
    stack: usize,
    path: String,
}

#[derive(Clone, Copy, Debug)]
struct Size {
    prims: u64,
    levels: u32,
}

/// Prim specs of all layers of a stack, merged.
#[derive(Default)]
struct Merged {
    children: Vec<String>,
    variants: BTreeMap<String, BTreeSet<String>>,
    arcs: Vec<Place>,
    is_instance: bool,
}

/// Kind of the parts that a size is the sum of.
enum Part {
    Child,
    Arc,
    /// Of a variant set, by number.
    Variant(usize),
}

/// A prim whose parts are being counted.
struct Open {
    place: Place,
    parts: Vec<(Part, Place)>,
    next: usize,
    size: Size,
    /// Prims of the largest variant of every set.
    variants: Vec<u64>,
}

struct Counting<'a> {
    layers: &'a BTreeMap<String, LayerSpec>,
    instances: Instances,
    /// Layer stacks: the key of their root layer, and all their layers, strongest first.
    stacks: Vec<(String, Rc<Vec<&'a LayerSpec>>)>,
    known: HashMap<Place, Size>,
    /// Prototypes of instances that are still to be counted, where instances count once.
    prototypes: Vec<Place>,
}

impl<'a> Counting<'a> {
    /// Number of the layer stack of a root layer.
    fn stack(&mut self, root: &str) -> usize {
        if let Some(known) = self.stacks.iter().position(|(key, _)| key == root) {
            return known;
        }
        let (mut found, mut seen, mut open) = (Vec::new(), BTreeSet::new(), vec![root.to_owned()]);
        while let Some(key) = open.pop() {
            let Some(layer) = self.layers.get(&key) else { continue };
            if seen.insert(key) {
                found.push(layer);
                let sublayers = layer.sublayers.iter().rev().filter_map(|asset| layer.targets.get(asset));
                open.extend(sublayers.cloned());
            }
        }
        self.stacks.push((root.to_owned(), Rc::new(found)));
        self.stacks.len() - 1
    }

    fn merged(&mut self, place: &Place) -> Merged {
        let layers = Rc::clone(&self.stacks[place.stack].1);
        let specs: Vec<(&LayerSpec, &PrimSpec)> =
            layers.iter().filter_map(|layer| Some((*layer, layer.prims.get(&place.path)?))).collect();
        if specs.iter().find_map(|(_, spec)| spec.active) == Some(false) {
            return Merged::default();
        }
        let mut merged = Merged::default();
        let mut seen = BTreeSet::new();
        for (layer, spec) in &specs {
            merged.children.extend(spec.children.iter().filter(|child| seen.insert(*child)).cloned());
            for (set, variants) in &spec.variants {
                merged.variants.entry(set.clone()).or_default().extend(variants.iter().cloned());
            }
            for Arc { asset, prim } in &spec.arcs {
                let stack = match layer.targets.get(asset) {
                    _ if asset.is_empty() => place.stack,
                    Some(target) => self.stack(target),
                    None => continue,
                };
                let path = if prim.is_empty() {
                    let root = self.stacks[stack].1.first();
                    root.map(|root| root.default_prim.clone()).unwrap_or_default()
                } else {
                    prim.clone()
                };
                merged.arcs.push(Place { stack, path });
            }
        }
        let says = |stack: usize, path: &str| {
            self.stacks[stack].1.iter().find_map(|layer| layer.prims.get(path)?.instanceable)
        };
        let own = specs.iter().find_map(|(_, spec)| spec.instanceable);
        let instanceable = own.or_else(|| merged.arcs.iter().find_map(|arc| says(arc.stack, &arc.path)));
        merged.is_instance = instanceable == Some(true) && !merged.arcs.is_empty();
        merged
    }

    fn open(&mut self, place: Place) -> Open {
        // What comes back to itself, which usd-core refuses, counts as nothing there.
        self.known.insert(place.clone(), Size { prims: 1, levels: 0 });
        let mut merged = self.merged(&place);
        if merged.is_instance && self.instances == Instances::Once {
            self.prototypes.append(&mut merged.arcs);
            merged = Merged::default();
        }
        let stack = place.stack;
        let below = |path: String| Place { stack, path };
        let mut parts: Vec<(Part, Place)> = Vec::new();
        parts.extend(merged.children.into_iter().map(|path| (Part::Child, below(path))));
        parts.extend(merged.arcs.into_iter().map(|place| (Part::Arc, place)));
        let sets = merged.variants.len();
        for (set, variants) in merged.variants.into_values().enumerate() {
            parts.extend(variants.into_iter().map(|path| (Part::Variant(set), below(path))));
        }
        Open { place, parts, next: 0, size: Size { prims: 1, levels: 0 }, variants: vec![0; sets] }
    }

    /// Size of what is at a place, itself included.
    fn size(&mut self, place: Place) -> Size {
        if let Some(known) = self.known.get(&place) {
            return *known;
        }
        // A stack of its own: chains of references may be longer than that of the thread is high.
        let mut open = vec![self.open(place)];
        let mut last = Size { prims: 1, levels: 0 };
        while let Some(top) = open.last_mut() {
            let Some((part, place)) = top.parts.get(top.next) else {
                let variants: u64 = top.variants.iter().fold(0, |sum, most| sum.saturating_add(*most));
                last = Size { prims: top.size.prims.saturating_add(variants), ..top.size };
                self.known.insert(top.place.clone(), last);
                open.pop();
                continue;
            };
            let Some(size) = self.known.get(place).copied() else {
                let place = place.clone();
                let next = self.open(place);
                open.push(next);
                continue;
            };
            top.size.levels = top.size.levels.max(size.levels + 1);
            match part {
                Part::Child => top.size.prims = top.size.prims.saturating_add(size.prims),
                Part::Arc => top.size.prims = top.size.prims.saturating_add(size.prims - 1),
                Part::Variant(set) => top.variants[*set] = top.variants[*set].max(size.prims - 1),
            }
            top.next += 1;
        }
        last
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(asset: &str, prim: &str) -> Arc {
        Arc { asset: asset.into(), prim: prim.into() }
    }

    /// A layer of prims with arcs; parents come before their children.
    fn layer(prims: &[(&str, &[Arc])]) -> LayerSpec {
        let mut layer = LayerSpec::default();
        layer.prims.insert("/".into(), PrimSpec::default());
        for (path, arcs) in prims {
            let parent =
                path.rsplit_once('/').map_or("/", |(above, _)| if above.is_empty() { "/" } else { above });
            let spec = PrimSpec { arcs: arcs.to_vec(), ..PrimSpec::default() };
            layer.prims.insert((*path).to_owned(), spec);
            layer.prims.get_mut(parent).unwrap().children.push((*path).to_owned());
        }
        layer
    }

    fn counted(layers: &[(&str, LayerSpec)], instances: Instances) -> Expansion {
        let layers = layers.iter().map(|(key, layer)| ((*key).to_owned(), layer.clone())).collect();
        expand(&layers, "root", instances)
    }

    /// `/P0` holds one prim, every further one ten copies of the one before.
    fn doubling(levels: usize, instanceable: bool) -> LayerSpec {
        let mut prims = vec![("/P0".to_owned(), Vec::new()), ("/P0/s".to_owned(), Vec::new())];
        for level in 1..=levels {
            prims.push((format!("/P{level}"), Vec::new()));
            let copies =
                (0..10).map(|k| (format!("/P{level}/c{k}"), vec![arc("", &format!("/P{}", level - 1))]));
            prims.extend(copies);
        }
        let borrowed: Vec<(&str, &[Arc])> =
            prims.iter().map(|(path, arcs)| (path.as_str(), arcs.as_slice())).collect();
        let mut layer = layer(&borrowed);
        for spec in layer.prims.values_mut().filter(|spec| !spec.arcs.is_empty()) {
            spec.instanceable = Some(instanceable);
        }
        layer
    }

    #[test]
    fn copies_of_copies_are_counted_without_making_them() {
        // P0 has 2 prims, P1 has 1 + 10 * 2, P2 has 1 + 10 * 21, ...
        let expected = [2, 21, 211, 2111];
        let total: u64 = expected.iter().sum();
        for instances in [Instances::Each, Instances::Once] {
            let found = counted(&[("root", doubling(3, false))], instances);
            assert_eq!((found.written, found.prims), (35, total));
            assert_eq!(found.largest, Some(("/P3".to_owned(), 2111)));
        }
        let instanced = doubling(8, true);
        assert!(counted(&[("root", instanced.clone())], Instances::Each).prims > 200_000_000);
        // Composed once: what is written, and the prototypes.
        assert!(counted(&[("root", instanced)], Instances::Once).prims < 300);
        let endless = counted(&[("root", doubling(200, false))], Instances::Each);
        assert_eq!(endless.prims, u64::MAX - 1, "no overflow");
    }

    #[test]
    fn layers_of_a_stack_and_opinions_are_no_copies() {
        let mut root = layer(&[("/World", &[]), ("/World/a", &[arc("asset", "")])]);
        root.sublayers = vec!["below".into()];
        root.targets = [("below", "below"), ("asset", "asset")].map(|(a, b)| (a.into(), b.into())).into();
        let below = layer(&[("/World", &[]), ("/World/a", &[]), ("/World/b", &[])]);
        let mut asset = layer(&[("/X", &[]), ("/X/y", &[]), ("/Other", &[])]);
        asset.default_prim = "/X".into();
        let found = counted(&[("root", root), ("below", below), ("asset", asset)], Instances::Each);
        // World, a, its y, and b.
        assert_eq!(found.prims, 4);
    }

    #[test]
    fn one_variant_of_a_set_counts_and_what_is_inactive_does_not() {
        let mut root = layer(&[("/A", &[]), ("/A{lod=full}", &[]), ("/A{lod=half}", &[])]);
        root.prims.get_mut("/").unwrap().children.truncate(1);
        let variants = ["/A{lod=full}", "/A{lod=half}"].map(str::to_owned).to_vec();
        root.prims.get_mut("/A").unwrap().variants.insert("lod".to_owned(), variants);
        for (path, children) in [("/A{lod=full}", 3), ("/A{lod=half}", 2)] {
            let spec = root.prims.get_mut(path).unwrap();
            spec.children = (0..children).map(|k| format!("{path}c{k}")).collect();
        }
        assert_eq!(counted(&[("root", root.clone())], Instances::Each).prims, 1 + 3);
        root.prims.get_mut("/A").unwrap().active = Some(false);
        assert_eq!(counted(&[("root", root)], Instances::Each).prims, 1);
    }

    #[test]
    fn long_chains_and_circles_end() {
        let chain: Vec<(String, Vec<Arc>)> =
            (0..100_000).map(|k| (format!("/P{k}"), vec![arc("", &format!("/P{}", k + 1))])).collect();
        let borrowed: Vec<(&str, &[Arc])> =
            chain.iter().map(|(path, arcs)| (path.as_str(), arcs.as_slice())).collect();
        let found = counted(&[("root", layer(&borrowed))], Instances::Each);
        assert!(found.levels > 100_000 && found.prims == 100_000, "{found:?}");
        let circle = layer(&[("/A", &[arc("", "/B")]), ("/B", &[arc("", "/A")]), ("/B/c", &[arc("", "/B")])]);
        assert_eq!(counted(&[("root", circle)], Instances::Each).written, 3);
    }
}
