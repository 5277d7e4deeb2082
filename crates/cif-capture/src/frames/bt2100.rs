//! HLG and PQ video as phones record it, brought to the display values of sRGB.
//!
//! Signal to light of the display: Recommendation ITU-R BT.2100-2, tables 4 (PQ) and 5 (HLG, on a display of 1000 cd/m2,
//! whose system gamma is 1.2). White of paper has 203 cd/m2 there (Report ITU-R BT.2408-7, table 1); it becomes the white
//! of the display by the curve of Report ITU-R BT.2390-11, 5.4.1, which leaves middle tones as they are and bends what is
//! brighter. The curve works on the largest component, so that hues stay. Primaries: Recommendation ITU-R BT.2087-0.

use super::pixmap::{Pixmap, Samples};

/// Luminance of the brightest signal of HLG, and from which on that of PQ is white, cd/m2.
const PEAK: f64 = 1000.0;

/// Luminance of white paper, which the display has as its white, cd/m2.
const WHITE: f64 = 203.0;

/// Entries of the tables that are looked up by the root of light, and by light.
const ENTRIES: usize = 1 << 14;

/// How signal becomes light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Transfer {
    /// Hybrid log-gamma.
    Hlg,
    /// Perceptual quantiser.
    Pq,
}

/// Primaries of the light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Primaries {
    Bt2020,
    Bt709,
}

impl Transfer {
    /// By the name that ffmpeg has for it.
    pub(super) fn of(name: &str) -> Option<Self> {
        match name {
            "arib-std-b67" => Some(Self::Hlg),
            "smpte2084" => Some(Self::Pq),
            _ => None,
        }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Hlg => "HLG",
            Self::Pq => "PQ",
        }
    }

    /// Light of a signal from 0 to 1: of the scene from 0 to 1 (HLG), of the display in shares of [`PEAK`] (PQ).
    fn light(self, signal: f64) -> f64 {
        match self {
            Self::Hlg => {
                let (a, b, c) = (0.178_832_77, 0.284_668_92, 0.559_910_73);
                if signal <= 0.5 { signal * signal / 3.0 } else { (((signal - c) / a).exp() + b) / 12.0 }
            }
            Self::Pq => pq_light(signal) / PEAK,
        }
    }
}

const M1: f64 = 2610.0 / 16_384.0;
const M2: f64 = 2523.0 / 4096.0 * 128.0;
const C1: f64 = 3424.0 / 4096.0;
const C2: f64 = 2413.0 / 4096.0 * 32.0;
const C3: f64 = 2392.0 / 4096.0 * 32.0;

/// Luminance of a PQ signal, cd/m2.
fn pq_light(signal: f64) -> f64 {
    let root = signal.powf(1.0 / M2);
    10_000.0 * ((root - C1).max(0.0) / (C2 - C3 * root)).powf(1.0 / M1)
}

/// PQ signal of a luminance in cd/m2.
fn pq_signal(light: f64) -> f64 {
    let power = (light / 10_000.0).powf(M1);
    ((C1 + C2 * power) / (1.0 + C3 * power)).powf(M2)
}

/// The luminance of a display whose white is [`WHITE`] for one of a display of [`PEAK`], cd/m2.
fn bent(light: f64) -> f64 {
    let peak = pq_signal(PEAK);
    let most = pq_signal(WHITE) / peak;
    let knee = 1.5 * most - 0.5;
    let signal = pq_signal(light.min(PEAK)) / peak;
    if signal < knee {
        return light;
    }
    let t = (signal - knee) / (1.0 - knee);
    let (t2, t3) = (t * t, t * t * t);
    let bent = (2.0 * t3 - 3.0 * t2 + 1.0) * knee
        + (t3 - 2.0 * t2 + t) * (1.0 - knee)
        + (-2.0 * t3 + 3.0 * t2) * most;
    pq_light(bent * peak)
}

/// Display value of a share of white, sRGB (IEC 61966-2-1).
fn srgb(light: f64) -> f64 {
    if light <= 0.003_130_8 { 12.92 * light } else { 1.055 * light.powf(1.0 / 2.4) - 0.055 }
}

/// Tables of a conversion.
pub(super) struct Conversion {
    primaries: Primaries,
    /// Light of every signal of 16 bits.
    light: Vec<f32>,
    /// True where light is that of the scene.
    of_scene: bool,
    /// Share of white per share of peak, by the root of the share of peak.
    gain: Vec<f32>,
    /// Display value by share of white.
    value: Vec<u8>,
}

impl Conversion {
    pub(super) fn new(transfer: Transfer, primaries: Primaries) -> Self {
        let last = (ENTRIES - 1) as f64;
        let gain = |k: usize| {
            // The first entry is that of its neighbour, to which it is equal.
            let share = (k.max(1) as f64 / last).powi(2);
            (bent(share * PEAK) / WHITE / share) as f32
        };
        Self {
            primaries,
            light: (0..=u16::MAX).map(|signal| transfer.light(f64::from(signal) / 65_535.0) as f32).collect(),
            of_scene: transfer == Transfer::Hlg,
            gain: (0..ENTRIES).map(gain).collect(),
            value: (0..ENTRIES).map(|k| (255.0 * srgb(k as f64 / last)).round() as u8).collect(),
        }
    }

    /// A frame of 16 bits as red, green and blue of 8 bits; one of 8 bits is returned as it is.
    pub(super) fn display(&self, frame: Pixmap) -> Pixmap {
        let Samples::Sixteen(samples) = &frame.samples else { return frame };
        let mut pixels = Vec::with_capacity(samples.len() / 2);
        for pixel in samples.chunks_exact(6) {
            let signal = |k: usize| usize::from(u16::from_be_bytes([pixel[2 * k], pixel[2 * k + 1]]));
            pixels.extend(self.pixel([signal(0), signal(1), signal(2)]));
        }
        Pixmap { samples: Samples::Eight(pixels), ..frame }
    }

    fn pixel(&self, signal: [usize; 3]) -> [u8; 3] {
        let mut light = signal.map(|signal| self.light[signal]);
        if self.of_scene {
            let luminance = 0.2627 * light[0] + 0.6780 * light[1] + 0.0593 * light[2];
            // The system gamma of a display of 1000 cd/m2 is 1.2.
            let factor = luminance.powf(0.2);
            light = light.map(|light| light * factor);
        }
        let largest = light[0].max(light[1]).max(light[2]).min(1.0);
        let gain = self.gain[(largest.sqrt() * (ENTRIES - 1) as f32 + 0.5) as usize];
        let [r, g, b] = light.map(|light| light.min(1.0) * gain);
        let shown = match self.primaries {
            Primaries::Bt709 => [r, g, b],
            Primaries::Bt2020 => [
                1.660_491 * r - 0.587_641_1 * g - 0.072_849_9 * b,
                -0.124_550_5 * r + 1.132_899_9 * g - 0.008_349_4 * b,
                -0.018_150_8 * r - 0.100_578_9 * g + 1.118_729_7 * b,
            ],
        };
        shown.map(|share| self.value[(share.clamp(0.0, 1.0) * (ENTRIES - 1) as f32 + 0.5) as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(transfer: Transfer, signal: [f64; 3]) -> [u8; 3] {
        let conversion = Conversion::new(transfer, Primaries::Bt2020);
        conversion.pixel(signal.map(|signal| (signal * 65_535.0).round() as usize))
    }

    #[test]
    fn signals_have_the_luminances_of_the_reports() {
        // BT.2408-7, table 1: white paper is 75 % HLG and 58 % PQ, grey card 38 % and 38 %, 203 and 26 cd/m2.
        let hlg = |signal: f64| PEAK * Transfer::Hlg.light(signal).powf(1.2);
        assert!((hlg(0.75) - 203.0).abs() < 1.0, "{}", hlg(0.75));
        assert!((hlg(0.38) - 26.0).abs() < 1.0, "{}", hlg(0.38));
        assert!((pq_light(0.58) - 203.0).abs() < 3.0, "{}", pq_light(0.58));
        assert!((pq_light(0.38) - 26.0).abs() < 1.0, "{}", pq_light(0.38));
        assert!((hlg(1.0) - 1000.0).abs() < 1e-3 && (pq_light(1.0) - 10_000.0).abs() < 1e-6);
        for light in [0.01, 1.0, 26.0, 203.0, 1000.0, 10_000.0] {
            assert!((pq_light(pq_signal(light)) / light - 1.0).abs() < 1e-9, "{light}");
        }
    }

    #[test]
    fn middle_tones_stay_and_highlights_bend_to_white() {
        assert_eq!(bent(26.0), 26.0);
        assert!((bent(PEAK) - WHITE).abs() < 1e-6 && (bent(4000.0) - WHITE).abs() < 1e-6);
        let curve: Vec<f64> = (1..=1000).map(|light| bent(f64::from(light))).collect();
        assert!(curve.windows(2).all(|pair| pair[1] > pair[0] - 1e-9), "it never falls");
        // Smooth at the knee: no slope above the one below it.
        assert!(curve.windows(2).all(|pair| pair[1] - pair[0] < 1.0 + 1e-6));
    }

    #[test]
    fn both_transfers_show_the_same_greys() {
        // Grey card: 26 / 203 of white, as a display value.
        let card = (255.0 * srgb(26.0 / 203.0)).round() as i32;
        for (hlg, pq) in [(0.38, 0.381), (0.75, 0.5807), (1.0, 0.7518)] {
            let (hlg, pq) = (shown(Transfer::Hlg, [hlg; 3]), shown(Transfer::Pq, [pq; 3]));
            assert!(hlg.iter().zip(&pq).all(|(a, b)| a.abs_diff(*b) <= 1), "{hlg:?} {pq:?}");
            assert!(hlg.iter().all(|value| value.abs_diff(hlg[0]) <= 1), "grey stays grey: {hlg:?}");
        }
        assert!((i32::from(shown(Transfer::Hlg, [0.38; 3])[0]) - card).abs() <= 2);
        assert_eq!(shown(Transfer::Hlg, [0.0; 3]), [0; 3]);
        assert_eq!(shown(Transfer::Pq, [1.0; 3]), [255; 3]);
    }

    #[test]
    fn colours_inside_the_primaries_of_the_display_come_out_as_they_are() {
        // Red of BT.709 at 50 cd/m2 in the primaries of BT.2020 (BT.2087-0, table 1), as PQ signals.
        let signal = [0.6274, 0.0691, 0.0164].map(|share| pq_signal(50.0 * share));
        let red = shown(Transfer::Pq, signal);
        assert!(red[0].abs_diff((255.0 * srgb(50.0 / 203.0)).round() as u8) <= 1, "{red:?}");
        assert!(red[1] <= 4 && red[2] <= 4, "{red:?}");
    }
}
