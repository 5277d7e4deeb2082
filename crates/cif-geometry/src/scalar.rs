//! The number type of the reference formulas.

use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{AddAssign, DivAssign, MulAssign, SubAssign};

/// `f32` or `f64`: one source for the shipped precision and for the oracle.
pub trait Real:
    num_traits::Float
    + num_traits::FloatConst
    + AddAssign
    + SubAssign
    + MulAssign
    + DivAssign
    + Sum
    + Debug
    + Display
    + Default
    + Send
    + Sync
    + 'static
{
    /// The nearest value of this type.
    fn of(value: f64) -> Self;

    /// The value in double precision.
    fn to_double(self) -> f64;
}

impl Real for f32 {
    fn of(value: f64) -> Self {
        value as f32
    }

    fn to_double(self) -> f64 {
        f64::from(self)
    }
}

impl Real for f64 {
    fn of(value: f64) -> Self {
        value
    }

    fn to_double(self) -> f64 {
        self
    }
}

/// The logistic function, accurate at both ends.
pub fn sigmoid<R: Real>(logit: R) -> R {
    if logit >= R::zero() {
        R::one() / (R::one() + (-logit).exp())
    } else {
        let e = logit.exp();
        e / (R::one() + e)
    }
}

/// The logistic function as it is defined, in one branch: finite everywhere, but for negative logits other in the last
/// bits than [`sigmoid`]. For results that were computed so and stay the same bit for bit.
pub fn direct_sigmoid<R: Real>(logit: R) -> R {
    R::one() / (R::one() + (-logit).exp())
}

/// Inverse of [`sigmoid`]; `probability` must lie strictly inside (0, 1).
pub fn logit<R: Real>(probability: R) -> R {
    probability.ln() - (-probability).ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logit_inverts_sigmoid() {
        for x in [-12.0_f64, -3.891_820_298, -0.5, 0.0, 2.0, 10.0] {
            assert!((logit(sigmoid(x)) - x).abs() < 1e-9 * (1.0 + x.abs()), "{x}");
        }
        assert!((logit(0.02_f64) + 3.891_820_298_110_627).abs() < 1e-12);
    }

    #[test]
    fn sigmoid_is_finite_at_the_ends() {
        assert_eq!(sigmoid(f32::NEG_INFINITY), 0.0);
        assert_eq!(sigmoid(1000.0_f32), 1.0);
        assert_eq!(direct_sigmoid(-1000.0_f32), 0.0);
        assert_eq!(direct_sigmoid(1000.0_f32), 1.0);
    }

    #[test]
    fn both_sigmoids_agree_but_for_rounding() {
        for logit in [-30.0_f64, -2.0, 0.0, 0.7, 12.0] {
            let (stable, direct) = (sigmoid(logit), direct_sigmoid(logit));
            assert!((stable - direct).abs() <= 4.0 * f64::EPSILON * stable, "{logit}: {stable} and {direct}");
        }
    }
}
