//! The built program and the library from outside: one binary, so that one built tileset serves all.
//!
//! | module | asks |
//! |---|---|
//! | `cli` | flags, exit codes, what is left on disk, signals |
//! | `audit` | certificates hold, planted faults are found and named, exit codes, the page, rewritten errors |
//! | `compare` | figures of known shapes, labels, refusals |
//! | `bad_input` | every kind of broken input ends in one sentence and the designed exit code |
//! | `determinism` | same input, same bytes, for any number of threads |
//! | `tileset` | what a published tileset promises, measured with readers and oracles of the tests' own |
//! | `formats` | hundreds of odd files of other projects: no panic, no hang, no memory |
//! | `tilesets` | tilesets of others, valid and invalid: read, or refused by a reason |
//! | `layers` | which module may know which |
//! | `real` | a real scan, from end to end |
//!
//! `ROOFTILE_DATA` names the folder of real scans and odd files. Without it those tests are skipped, and say so; where
//! `CI` is set they fail instead.

mod audit;
mod bad_input;
mod cli;
mod common;
mod compare;
mod determinism;
mod formats;
mod layers;
mod real;
mod tileset;
mod tilesets;
