//! The built program and the library from outside: one binary, so that one built tileset serves all.
//!
//! | module | asks |
//! |---|---|
//! | `cli` | flags, exit codes, what is left on disk, signals |
//! | `bad_input` | every kind of broken input ends in one sentence and the designed exit code |
//! | `determinism` | same input, same bytes, for any number of threads |
//! | `tileset` | what a published tileset promises, measured with readers and oracles of the tests' own |
//! | `walls` | gaps between tiles of different levels are no wider than stated, and skirts close them |
//! | `safety` | errors, budgets and sinking per class hold when they are measured from outside |
//! | `formats` | hundreds of odd files of other projects: no panic, no hang, no memory |
//! | `layers` | which module may know which |
//! | `real` | a real scan, from end to end |
//!
//! `ROOFTILE_DATA` names the folder of real scans and odd files. Without it those tests are skipped, and say so; where
//! `CI` is set they fail instead.

mod bad_input;
mod cli;
mod common;
mod determinism;
mod formats;
mod layers;
mod real;
mod safety;
mod tileset;
mod walls;
