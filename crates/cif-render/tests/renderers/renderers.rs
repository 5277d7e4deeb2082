//! A training view through every renderer, in one form that is compared with the reference in double precision.

use cif_field::parameters::Parameter;
use cif_render::cpu::{ForwardPass, Renderer, SimdLevel};
use cif_render::reference::Scene;
use cif_render::synthetic::SyntheticScene;
use cif_render::{Gradients, RenderSettings};

use crate::support::{Cotangents, render};

/// A renderer that is held to the reference in double precision.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Path {
    /// Reference in single precision.
    Single,
    /// Fast path at a level of vector instructions.
    Fast(SimdLevel),
    /// GPU.
    Gpu,
}

/// Gradient of a parameter at an index.
type GradientAt = Box<dyn Fn(Parameter, usize) -> f64>;

/// Everything that comes back of a training view.
pub(crate) struct Seen {
    /// Where from.
    pub(crate) path: Path,
    /// Colours, `[H, W]`.
    pub(crate) colors: Vec<[f64; 3]>,
    /// Colour transmittance, blended depth (m), label probability and instance transmittance, `[H, W]`, of renderers
    /// that keep them.
    pub(crate) blended: Option<Vec<[f64; 4]>>,
    /// Mean instance loss with the labelled and the unsupported pixels, of renderers that sum it.
    pub(crate) loss: Option<(f64, usize, usize)>,
    /// Gradients by the projected centres, `[N]`.
    pub(crate) screen: Vec<[f64; 2]>,
    /// Screen radii in pixels, `[N]`; 0 where invisible.
    pub(crate) radii: Vec<f64>,
    gradient: GradientAt,
}

impl Seen {
    /// Gradient by scalar `index` of a parameter.
    pub(crate) fn gradient(&self, parameter: Parameter, index: usize) -> f64 {
        (self.gradient)(parameter, index)
    }
}

/// A view through the levels or devices of a renderer.
pub(crate) type RenderView = fn(&SyntheticScene, &RenderSettings, &Cotangents) -> Vec<Seen>;

/// The view through every renderer that there is here.
pub(crate) fn everywhere(
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
) -> Vec<Seen> {
    let all: [RenderView; 3] = [on_reference, on_processor, on_gpu];
    all.iter().flat_map(|renderer| renderer(scene, settings, cotangents)).collect()
}

/// The view through the reference in single precision.
pub(crate) fn on_reference(
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
) -> Vec<Seen> {
    vec![single(scene, settings, cotangents)]
}

/// The view through the fast path at every level of vector instructions.
pub(crate) fn on_processor(
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
) -> Vec<Seen> {
    SimdLevel::available().into_iter().map(|simd| fast(simd, scene, settings, cotangents)).collect()
}

fn single(synthetic: &SyntheticScene, settings: &RenderSettings, cotangents: &Cotangents) -> Seen {
    let scene = Scene::<f32>::from_field(&synthetic.field);
    let forward = render(&scene, synthetic, settings);
    let gradients = cotangents.backward(&scene, &forward);
    let state = &forward.pixels.pixels;
    let blended = |s: &cif_render::reference::PixelState<f32>| {
        [s.transmittance, s.depth, s.label_probability, s.instance_transmittance].map(f64::from)
    };
    Seen {
        path: Path::Single,
        colors: forward.color.pixels.iter().map(|color| color.map(f64::from)).collect(),
        blended: Some(state.iter().map(blended).collect()),
        loss: Some((
            f64::from(forward.loss.mean),
            forward.loss.labelled_pixels,
            forward.loss.unsupported_pixels,
        )),
        screen: gradients.screen.iter().map(|v| v.map(f64::from)).collect(),
        radii: forward.splats.iter().map(|s| s.as_ref().map_or(0.0, |s| f64::from(s.radius))).collect(),
        gradient: Box::new(move |group, index| f64::from(gradients.parameters.get(group, index))),
    }
}

fn fast(simd: SimdLevel, scene: &SyntheticScene, settings: &RenderSettings, cotangents: &Cotangents) -> Seen {
    let mut gradients = Gradients::zeros(&scene.field);
    let forward = forward_and_backward(simd, scene, settings, cotangents, &mut gradients);
    Seen {
        path: Path::Fast(simd),
        colors: forward.color.pixels.iter().map(|color| color.map(f64::from)).collect(),
        blended: None,
        loss: Some((forward.instance_loss, forward.labelled_pixels, forward.unsupported_pixels)),
        screen: gradients.screen.iter().map(|v| v.map(f64::from)).collect(),
        radii: gradients.radii.iter().map(|radius| f64::from(*radius)).collect(),
        gradient: Box::new(move |group, index| fast_gradient(&gradients, group, index)),
    }
}

/// A view of the fast path, which adds to `gradients`; those of coverage without instances alone.
pub(crate) fn forward_and_backward(
    simd: SimdLevel,
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
    gradients: &mut Gradients,
) -> ForwardPass {
    let mut renderer = Renderer::new(simd);
    let forward = renderer.forward(&scene.field, &scene.camera, scene.time, settings, Some(&scene.labels));
    let v_color = cotangents.color.map(|color| color.map(|v| v as f32));
    match cotangents.alpha.as_ref().filter(|_| settings.instances.is_none()) {
        None => renderer.backward(&scene.field, &v_color, cotangents.instance_weight as f32, gradients),
        Some(alpha) => {
            let v_alpha = alpha.map(|v| *v as f32);
            renderer.backward_with_alpha(&scene.field, &v_color, &v_alpha, gradients);
        }
    }
    forward
}

/// Scalar `index` of a parameter of the fast path's gradients.
pub(crate) fn fast_gradient(gradients: &Gradients, parameter: Parameter, index: usize) -> f64 {
    let tensor = gradients.tensors().into_iter().find(|(other, _)| *other == parameter);
    f64::from(tensor.expect("a parameter of the table").1[index])
}

/// The view on the GPU; empty where there is none.
#[cfg(feature = "wgpu")]
pub(crate) fn on_gpu(
    scene: &SyntheticScene,
    settings: &RenderSettings,
    cotangents: &Cotangents,
) -> Vec<Seen> {
    let Some(mut device) = crate::on_gpu::device() else { return Vec::new() };
    let seen = crate::on_gpu::run(&mut device, scene, settings, cotangents, |_| {}).unwrap();
    vec![seen_on_gpu(seen)]
}

/// Results that were read back from the GPU, in the common form.
#[cfg(feature = "wgpu")]
pub(crate) fn seen_on_gpu(seen: crate::on_gpu::Outcome) -> Seen {
    let three = |v: &[f32; 4]| [0, 1, 2].map(|k| f64::from(v[k]));
    let blended = seen.colors.iter().zip(&seen.blended).map(|(color, blended)| {
        let [depth, label, instance, _] = blended.map(f64::from);
        [f64::from(color[3]), depth, label, instance]
    });
    Seen {
        path: Path::Gpu,
        colors: seen.colors.iter().map(three).collect(),
        blended: Some(blended.collect()),
        loss: None,
        screen: seen.screen.iter().map(|v| [0, 1].map(|k| f64::from(v[k]))).collect(),
        radii: seen.screen.iter().map(|v| if v[3] > 0.0 { f64::from(v[2]) } else { 0.0 }).collect(),
        gradient: Box::new(move |parameter, index| seen.gradient(parameter, index)),
    }
}

#[cfg(not(feature = "wgpu"))]
fn on_gpu(_: &SyntheticScene, _: &RenderSettings, _: &Cotangents) -> Vec<Seen> {
    Vec::new()
}
