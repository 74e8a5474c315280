//! For what reads runs and recordings.

pub mod damage;
mod run;

pub use run::run;
