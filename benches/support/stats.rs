//! The doctor's statistics, and what only a bench needs.

pub use fieldbeat_doctor::stats::*;

/// A straight line through points.
#[derive(Clone, Copy, Debug)]
pub struct Line {
    /// Per unit of x.
    pub slope: f64,
    /// At x = 0.
    pub intercept: f64,
}

impl Line {
    /// The line with the smallest sum of squared relative errors: points at small x count as much as those at large x.
    pub fn through(points: &[(f64, f64)]) -> Line {
        let (mut s, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (x, y) in points {
            let weight = 1.0 / (y * y);
            s += weight;
            sx += weight * x;
            sy += weight * y;
            sxx += weight * x * x;
            sxy += weight * x * y;
        }
        let slope = (s * sxy - sx * sy) / (s * sxx - sx * sx);
        Line { slope, intercept: (sy - slope * sx) / s }
    }

    /// How much of the points' spread it explains: 1 is all.
    pub fn r_squared(&self, points: &[(f64, f64)]) -> f64 {
        let mean = points.iter().map(|(_, y)| y).sum::<f64>() / points.len() as f64;
        let off: f64 = points.iter().map(|(x, y)| (y - self.at(*x)).powi(2)).sum();
        1.0 - off / points.iter().map(|(_, y)| (y - mean).powi(2)).sum::<f64>()
    }

    /// At `x`.
    pub fn at(&self, x: f64) -> f64 {
        self.intercept + self.slope * x
    }
}
