//! The built program and the library from outside: one binary, so that one built tileset serves all.
//!
//! | module | asks |
//! |---|---|
//! | `cli` | flags, exit codes, what is left on disk, signals |
//! | `audit` | certificates hold, planted faults are found and named, exit codes, the page, rewritten errors |
//! | `audit_kinds` | the audit on implicit, packed, composite, compressed, georeferenced tilesets, along routes, against originals |
//! | `compare` | figures of known shapes, labels, refusals |
//! | `bad_input` | every kind of broken input ends in one sentence and the designed exit code |
//! | `determinism` | same input, same bytes, for any number of threads |
//! | `experiment` | files and numbers of the paper's experiment
//! | `tileset` | what a published tileset promises, measured with readers and oracles of the tests' own |
//! | `walls` | gaps between tiles of different levels are no wider than stated, and skirts close them |
//! | `safety` | errors, budgets and sinking per class hold when they are measured from outside |
//! | `formats` | hundreds of odd files of other projects: no panic, no hang, no memory |
//! | `label` | labels, their truth, schemes of other classes, tuning, figures |
//! | `tilesets` | tilesets of others, valid and invalid: read, or refused by a reason |
//! | `layers` | which module may know which |
//! | `resume` | a killed build goes on, and nothing of that, of memory or of threads shows in the bytes |
//! | `real` | a real scan, from end to end |
//! | `real_classes` | labels of others on real meshes, and meshes without a building |
//! | `simplify` | a cut of a textured mesh has its look: files whole, coordinates in range, pictures alike |
//! | `record` | simplifying, recording and replaying, by the program |
//!
//! `ROOFTILE_DATA` names the folder of real scans and odd files. Without it those tests are skipped, and say so; where
//! `CI` is set they fail instead.

mod audit;
mod audit_kinds;
mod bad_input;
mod cli;
mod common;
mod compare;
mod determinism;
mod experiment;
mod formats;
mod front_end;
mod label;
mod layers;
mod real;
mod real_classes;
mod record;
mod resume;
mod safety;
mod simplify;
mod tileset;
mod tilesets;
mod walls;
