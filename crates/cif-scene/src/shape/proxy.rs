//! A light point cloud standing in for the splats.

use super::extent::SIGMAS;
use super::flat;
use crate::{PointProxy, Splats};

/// Picks at most `count` splats, spread over the node and denser where the splats are more important.
///
/// Importance is [`Splats::importance`]. Splats are walked along a Morton curve and
/// picked at equal steps of summed importance, so the choice needs no chance and covers the node evenly.
#[must_use]
pub fn point_proxy(splats: &Splats, count: usize) -> PointProxy {
    let importance = splats.importance();
    let mut indices: Vec<u32> = if splats.len() <= count {
        (0..splats.len() as u32).collect()
    } else {
        systematic(&morton_order(&splats.means), &importance, count)
    };
    indices.sort_unstable();
    let colors = splats.base_colors();
    // Fewer points stand for more surface each: widths grow with the square root of the reduction.
    let growth = (splats.len() as f64 / indices.len().max(1) as f64).sqrt();
    let widths = indices
        .iter()
        .map(|&index| {
            let sigma = flat::size(splats.scales[index as usize].map(|scale| f64::from(scale).ln()));
            (2.0 * sigma * growth.min(SIGMAS)) as f32
        })
        .collect();
    PointProxy { colors: indices.iter().map(|&index| colors[index as usize]).collect(), widths, indices }
}

/// Picks `count` items of `order` at equal steps of summed weight; each item at most once.
pub(crate) fn systematic(order: &[u32], weights: &[f64], count: usize) -> Vec<u32> {
    let total: f64 = order.iter().map(|&index| weights[index as usize]).sum();
    let mut picked = Vec::with_capacity(count);
    if total > 0.0 && total.is_finite() && count > 0 {
        let step = total / count as f64;
        let (mut sum, mut next) = (0.0, step / 2.0);
        for &index in order {
            sum += weights[index as usize];
            if sum >= next {
                picked.push(index);
                while next <= sum {
                    next += step;
                }
            }
        }
    } else {
        picked.extend(order.iter().take(count));
    }
    picked
}

/// Indices along a Morton curve of 21 bits per axis.
fn morton_order(means: &[[f32; 3]]) -> Vec<u32> {
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for mean in means {
        for axis in 0..3 {
            low[axis] = low[axis].min(mean[axis]);
            high[axis] = high[axis].max(mean[axis]);
        }
    }
    let code = |mean: &[f32; 3]| {
        let mut code = 0_u64;
        for axis in 0..3 {
            let size = (high[axis] - low[axis]).max(f32::MIN_POSITIVE);
            let cell = ((mean[axis] - low[axis]) / size * 2_097_151.0) as u64;
            code |= spread(cell.min(2_097_151)) << axis;
        }
        code
    };
    let mut order: Vec<(u64, u32)> =
        means.iter().enumerate().map(|(index, mean)| (code(mean), index as u32)).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, index)| index).collect()
}

/// Puts two zero bits between the 21 bits of `x`.
fn spread(mut x: u64) -> u64 {
    x = (x | x << 32) & 0x001f_0000_0000_ffff;
    x = (x | x << 16) & 0x001f_0000_ff00_00ff;
    x = (x | x << 8) & 0x100f_00f0_0f00_f00f;
    x = (x | x << 4) & 0x10c3_0c30_c30c_30c3;
    (x | x << 2) & 0x1249_2492_4924_9249
}

#[cfg(test)]
mod tests {
    use super::*;

    fn splats(count: usize) -> Splats {
        Splats {
            means: (0..count).map(|k| [k as f32, (k % 3) as f32, 0.0]).collect(),
            orientations: vec![[1.0, 0.0, 0.0, 0.0]; count],
            scales: vec![[0.1; 3]; count],
            opacities: vec![0.5; count],
            sh_degree: 0,
            sh_coefficients: vec![0.0; 3 * count],
            ..Splats::default()
        }
    }

    #[test]
    fn picks_spread_over_the_node() {
        let proxy = point_proxy(&splats(1000), 100);
        assert_eq!(proxy.indices.len(), 100);
        assert!(proxy.indices.windows(2).all(|pair| pair[0] < pair[1]), "each at most once");
        assert!(proxy.indices.windows(2).all(|pair| pair[1] - pair[0] < 60), "no large gap");
        assert_eq!(proxy.colors[0], [0.5; 3]);
    }

    #[test]
    fn important_splats_are_picked_more_often() {
        let mut splats = splats(1000);
        for opacity in &mut splats.opacities[..500] {
            *opacity = 0.05;
        }
        let proxy = point_proxy(&splats, 100);
        let faint = proxy.indices.iter().filter(|&&index| index < 500).count();
        assert!((5..20).contains(&faint), "{faint} of {}", proxy.indices.len());
    }

    #[test]
    fn few_splats_are_all_taken() {
        assert_eq!(point_proxy(&splats(5), 100).indices, [0, 1, 2, 3, 4]);
    }
}
