//! Places of a sphere that views of a ball show, and the texture that they make of it in some rotations.

use std::f64::consts::PI;

use glam::{DMat3, DQuat, DVec3, dvec2};
use nalgebra::{Matrix4, Vector4};

use super::rotation::Ball;
use super::texture::FEWEST;
use super::view::{ObjectView, median};

/// Most pixels of a view that are looked at.
const PIXELS: usize = 300;

/// Cosine of the angle to the surface from which a place is looked at.
const FACING: f64 = 0.35;

/// Added to colours before their logarithm is taken.
const DARK: f64 = 0.05;

/// Deviations of a logarithm from the middle of its view, in medians of these, beyond which it is cut: highlights are
/// light.
const HIGHLIGHT: f64 = 4.0;

/// Cells along the edges of the cube that a texture is kept on.
const CELLS: usize = 10;

/// Weight of places that are not seen, so that a few that agree by chance do not decide.
const UNSEEN: f64 = 0.1;

/// A place of the sphere at one time.
#[derive(Clone, Copy)]
struct Sample {
    /// Unit vector from the middle, in the world.
    outward: DVec3,
    value: DVec3,
    weight: f64,
}

/// Places that a time shows.
pub(super) struct Side {
    pub(super) time: usize,
    samples: Vec<Sample>,
}

/// Cell of a texture: sums of weighted values, of weights and of weighted squares.
#[derive(Clone, Copy, Default)]
struct Cell {
    values: DVec3,
    weight: f64,
    squares: f64,
}

/// A texture on a cube around the ball, in its frame.
#[derive(Clone)]
pub(super) struct Texture(Vec<Cell>);

/// Sums of products of values of two times, and of what these would be if they were the same.
#[derive(Clone, Copy, Default)]
pub(super) struct Agreement {
    products: f64,
    most: f64,
}

impl Side {
    /// The side that views of a time show of a ball of this radius, here.
    pub(super) fn of(time: usize, views: &[&ObjectView], centre: DVec3, radius: f64) -> Self {
        Self { time, samples: views.iter().flat_map(|view| samples(view, centre, radius)).collect() }
    }

    /// The side by one of every `step` of its places.
    pub(super) fn few(&self, step: usize) -> Self {
        Self { time: self.time, samples: self.samples.iter().step_by(step).copied().collect() }
    }

    /// Weight of all that it shows.
    pub(super) fn weight(&self) -> f64 {
        self.samples.iter().map(|sample| sample.weight).sum()
    }

    /// Root mean square of the values of some sides.
    pub(super) fn strength(sides: &[Self]) -> f64 {
        let samples = || sides.iter().flat_map(|side| &side.samples);
        let squares: f64 = samples().map(|sample| sample.weight * sample.value.length_squared()).sum();
        (squares / samples().map(|sample| sample.weight).sum::<f64>().max(1e-9)).sqrt()
    }
}

/// Places of the sphere that a view shows, without shading.
fn samples(view: &ObjectView, centre: DVec3, radius: f64) -> Vec<Sample> {
    let crop = &view.crops[0];
    let origin = view.camera.centre();
    let distance = (centre - origin).length();
    // A whole outline shows where the middle is and how large the ball looks.
    let (centre, radius) = if view.is_whole() {
        let pixels = (view.area() / PI).sqrt();
        let sine = (pixels / view.camera.focal_px.x).atan().sin();
        (origin + distance * view.camera.ray(view.centroid).normalize(), distance * sine)
    } else {
        (centre, radius)
    };
    let seen: Vec<usize> = (0..crop.mask.len()).filter(|pixel| crop.mask[*pixel] > 0.5).collect();
    let step = seen.len().div_ceil(PIXELS).max(1);
    let mut found = Vec::new();
    for pixel in seen.into_iter().step_by(step) {
        let column = pixel as u32 % crop.camera.width;
        let row = pixel as u32 / crop.camera.width;
        let ray = crop.camera.ray(dvec2(f64::from(column) + 0.5, f64::from(row) + 0.5)).normalize();
        let Some((outward, weight)) = (Ball { centre, radius }).outward(origin, ray) else { continue };
        if weight > FACING {
            let value = DVec3::from(crop.colors[pixel].map(|c| (f64::from(c) + DARK).ln()));
            found.push(Sample { outward, value, weight });
        }
    }
    take_shading_away(&mut found);
    found
}

/// Takes away shading, which is nearly linear in the direction outwards, and cuts highlights.
fn take_shading_away(samples: &mut [Sample]) {
    for axis in 0..3 {
        let (mut matrix, mut target) = (Matrix4::identity() * 1e-3, Vector4::zeros());
        let basis = |sample: &Sample| {
            let DVec3 { x, y, z } = sample.outward;
            Vector4::new(1.0, x, y, z)
        };
        for sample in samples.iter() {
            let row = basis(sample);
            matrix += sample.weight * row * row.transpose();
            target += sample.weight * sample.value[axis] * row;
        }
        let shading = matrix.cholesky().map(|matrix| matrix.solve(&target)).unwrap_or_default();
        samples.iter_mut().for_each(|sample| sample.value[axis] -= basis(sample).dot(&shading));
        let mut sizes: Vec<f64> = samples.iter().map(|sample| sample.value[axis].abs()).collect();
        let most = HIGHLIGHT * median(&mut sizes);
        samples.iter_mut().for_each(|sample| sample.value[axis] = sample.value[axis].clamp(-most, most));
    }
}

/// Takes away what stays where it is in the world while the ball moves.
pub(super) fn take_light_away(sides: &mut [Side], moves: impl Fn(usize) -> bool) {
    let moving: Vec<&Side> = sides.iter().filter(|side| moves(side.time)).collect();
    if moving.len() < FEWEST {
        return;
    }
    let mut light = Texture::empty();
    let mut most = 0.0_f64;
    for side in &moving {
        let of = Texture::of(side, DQuat::IDENTITY);
        most = most.max(of.0.iter().map(|cell| cell.weight).fold(0.0, f64::max));
        light.add(&of);
    }
    for sample in sides.iter_mut().flat_map(|side| &mut side.samples) {
        let cell = &light.0[cell(sample.outward)];
        sample.value -= cell.values / (cell.weight + 2.0 * most);
    }
}

impl Texture {
    pub(super) fn empty() -> Self {
        Self(vec![Cell::default(); 6 * CELLS * CELLS])
    }

    /// Texture that a side shows of a ball in some rotation.
    pub(super) fn of(side: &Side, rotation: DQuat) -> Self {
        let object_from_world = DMat3::from_quat(rotation.inverse());
        let mut texture = Self::empty();
        for sample in &side.samples {
            let cell = &mut texture.0[cell(object_from_world * sample.outward)];
            cell.values += sample.weight * sample.value;
            cell.weight += sample.weight;
            cell.squares += sample.weight * sample.value.length_squared();
        }
        texture
    }

    pub(super) fn add(&mut self, other: &Self) {
        for (cell, other) in self.0.iter_mut().zip(&other.0) {
            cell.values += other.values;
            cell.weight += other.weight;
            cell.squares += other.squares;
        }
    }

    pub(super) fn subtract(&mut self, other: &Self) {
        for (cell, other) in self.0.iter_mut().zip(&other.0) {
            cell.values -= other.values;
            cell.weight -= other.weight;
            cell.squares -= other.squares;
        }
    }

    /// Agreement with what a side shows in some rotation.
    pub(super) fn agreement(&self, side: &Side, rotation: DQuat) -> Agreement {
        let object_from_world = DMat3::from_quat(rotation.inverse());
        let mut sum = Agreement::default();
        for sample in &side.samples {
            let cell = &self.0[cell(object_from_world * sample.outward)];
            let scale = sample.weight / cell.weight.max(1.0);
            sum.products += scale * sample.value.dot(cell.values);
            sum.most += 0.5 * scale * (cell.weight * sample.value.length_squared() + cell.squares) + 1e-12;
            if cell.weight <= 0.0 {
                sum.most += UNSEEN * sample.weight * sample.value.length_squared();
            }
        }
        sum
    }
}

impl Agreement {
    pub(super) fn share(self) -> f64 {
        self.products / self.most.max(1e-12)
    }
}

impl std::ops::AddAssign for Agreement {
    fn add_assign(&mut self, other: Self) {
        self.products += other.products;
        self.most += other.most;
    }
}

/// Cell in a direction: of the face of a cube that it meets.
fn cell(direction: DVec3) -> usize {
    let sizes = direction.abs();
    let axis = if sizes.x >= sizes.y && sizes.x >= sizes.z {
        0
    } else if sizes.y >= sizes.z {
        1
    } else {
        2
    };
    let face = 2 * axis + usize::from(direction[axis] < 0.0);
    let place = |other: usize| {
        let share = 0.5 + 0.5 * direction[other] / sizes[axis].max(1e-12);
        ((share * CELLS as f64) as usize).min(CELLS - 1)
    };
    (face * CELLS + place((axis + 1) % 3)) * CELLS + place((axis + 2) % 3)
}
