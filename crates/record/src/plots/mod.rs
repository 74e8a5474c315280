//! The plots of a run, as parts of a page: SVG that takes the width it has, with its labels next to it, so that they
//! stay readable on a phone. Colours come from the page, light or dark.
//!
//! | file | what |
//! |---|---|
//! | `chart` | what all of them share: axes, curves, marks, legend |
//! | `scale` | from values to places, and the grid |
//! | `wake` | how many cycles began how late |
//! | `percentiles` | quantiles of the loop and of every drive |
//! | `timeline` | the largest values over the time of the run |
//! | `motion` | position, following error and velocity of an axis, and what happened to it |
//!
//! They show what was measured: a curve ends at the last quantile that its sample supports, and a maximum has a mark of
//! its own. A library that draws into a fixed size was in their place before (plotters): its labels shrink with the
//! plot, and its colours are fixed.

pub mod chart;
pub mod motion;
pub mod percentiles;
mod scale;
pub mod timeline;
pub mod wake;
