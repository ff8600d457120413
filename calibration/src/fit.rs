//! Linear least squares with known sigmas, and a loss that outliers cannot bend.

use nalgebra::{DMatrix, DVector};

/// Beyond this many sigma a residual counts linearly (Huber 1964).
const HUBER_SIGMA: f64 = 2.0;
/// Rounds of reweighting; weights settle after a few.
const ROUNDS: usize = 20;

/// What a linear fit found.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// Parameters.
    pub parameters: Vec<f64>,
    /// Their covariance, row-major.
    covariance: DMatrix<f64>,
    /// Weighted sum of squared residuals over the degrees of freedom; near 1 where the sigmas are right. 1 where nothing
    /// is left over to tell.
    pub reduced_chi2: f64,
}

impl Fit {
    /// Standard deviation of parameter `index`. Where the points scatter more than their sigmas say, so does the parameter.
    pub fn sigma(&self, index: usize) -> f64 {
        (self.covariance[(index, index)] * self.reduced_chi2.max(1.0)).sqrt()
    }

    /// Covariance of two parameters, likewise.
    pub fn covariance(&self, a: usize, b: usize) -> f64 {
        self.covariance[(a, b)] * self.reduced_chi2.max(1.0)
    }
}

/// Solves `rows * parameters = values`, each value with its sigma. `None` where the rows do not determine the parameters
/// or something is not finite.
pub fn linear<const N: usize>(rows: &[[f64; N]], values: &[f64], sigmas: &[f64]) -> Option<Fit> {
    let sound = sigmas.iter().all(|sigma| sigma.is_finite() && *sigma > 0.0);
    if rows.len() < N || !sound || values.iter().any(|value| !value.is_finite()) {
        return None;
    }
    // Columns of very different size would make the normal equations useless.
    let scale: [f64; N] =
        std::array::from_fn(|column| rows.iter().map(|row| row[column].abs()).fold(0.0, f64::max));
    if scale.iter().any(|scale| !(scale.is_finite() && *scale > 0.0)) {
        return None;
    }
    let mut weights = vec![1.0f64; rows.len()];
    let mut solved = None;
    for _ in 0..ROUNDS {
        let design = DMatrix::from_fn(rows.len(), N, |row, column| {
            weights[row].sqrt() * rows[row][column] / (sigmas[row] * scale[column])
        });
        let target = DVector::from_fn(rows.len(), |row, _| weights[row].sqrt() * values[row] / sigmas[row]);
        let inverse = (design.transpose() * &design).try_inverse()?;
        let found = &inverse * (design.transpose() * target);
        let parameters: Vec<f64> = found.iter().zip(scale).map(|(value, scale)| value / scale).collect();
        let mut chi2 = 0.0;
        for (index, row) in rows.iter().enumerate() {
            let modelled: f64 = row.iter().zip(&parameters).map(|(a, b)| a * b).sum();
            let residual = ((values[index] - modelled) / sigmas[index]).abs();
            weights[index] = if residual > HUBER_SIGMA { HUBER_SIGMA / residual } else { 1.0 };
            chi2 += weights[index] * residual * residual;
        }
        let covariance = DMatrix::from_fn(N, N, |a, b| inverse[(a, b)] / (scale[a] * scale[b]));
        let reduced_chi2 = if rows.len() > N { chi2 / (rows.len() - N) as f64 } else { 1.0 };
        solved = Some(Fit { parameters, covariance, reduced_chi2 });
    }
    solved.filter(|fit| fit.parameters.iter().all(|value| value.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    #[test]
    fn points_on_a_line_give_the_line() {
        let rows: Vec<[f64; 2]> = (0..7).map(|x| [1.0, 1e6 * f64::from(x)]).collect();
        let values: Vec<f64> = rows.iter().map(|row| 3.0 + 2e-6 * row[1]).collect();
        let fit = linear(&rows, &values, &[0.1; 7]).unwrap();
        assert!((fit.parameters[0] - 3.0).abs() < 1e-9 && (fit.parameters[1] - 2e-6).abs() < 1e-15);
        assert_eq!(fit.reduced_chi2.max(1e-12), 1e-12);
    }

    #[test]
    fn an_outlier_moves_the_line_little() {
        let rows: Vec<[f64; 2]> = (0..21).map(|x| [1.0, f64::from(x)]).collect();
        let mut values: Vec<f64> = rows.iter().map(|row| 1.0 + 0.5 * row[1]).collect();
        values[20] += 1000.0;
        let fit = linear(&rows, &values, &[0.1; 21]).unwrap();
        assert!((fit.parameters[1] - 0.5).abs() < 0.02, "{:?}", fit.parameters);
    }

    #[test]
    fn sigmas_are_what_parameters_scatter_by() {
        let mut random = StdRng::seed_from_u64(4);
        let rows: Vec<[f64; 2]> = (0..12).map(|x| [1.0, f64::from(x)]).collect();
        let (mut squares, mut sigma) = (0.0, 0.0);
        for _ in 0..400 {
            let noise = |random: &mut StdRng| (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
            let values: Vec<f64> = rows.iter().map(|row| 2.0 * row[1] + 0.3 * noise(&mut random)).collect();
            let fit = linear(&rows, &values, &[0.3; 12]).unwrap();
            squares += (fit.parameters[1] - 2.0).powi(2);
            sigma = fit.covariance[(1, 1)].sqrt();
        }
        let ratio = (squares / 400.0).sqrt() / sigma;
        assert!((0.85..1.2).contains(&ratio), "{ratio}");
    }

    #[test]
    fn what_cannot_be_determined_is_not_answered() {
        assert!(linear(&[[1.0, 2.0]; 5], &[1.0; 5], &[1.0; 5]).is_none_or(|fit| fit.sigma(0) > 1e3));
        assert!(linear(&[[1.0, 2.0]], &[1.0], &[1.0]).is_none());
        assert!(linear(&[[1.0], [2.0]], &[f64::NAN, 1.0], &[1.0; 2]).is_none());
        assert!(linear(&[[1.0], [2.0]], &[1.0, 1.0], &[0.0; 2]).is_none());
    }
}
