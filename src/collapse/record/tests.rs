use std::path::Path;

use glam::DVec3;
use proptest::prelude::*;

use super::*;
use crate::collapse::{Collapse, CollapseLog};
use crate::ids::{ClassId, ClassScheme};

const GRID_M: f64 = 1.0 / 128.0;

/// Pseudo-random numbers, the same in every run.
struct Dice(u64);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) as usize) % n.max(1)
    }
}

fn snapped(p: DVec3) -> DVec3 {
    (p / GRID_M).round() * GRID_M
}

/// A bumpy sheet of n × n cells, with fins, flaps, loose triangles and turned faces if `wild`.
fn sheet(n: u32, wild: bool, dice: &mut Dice) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut positions = Vec::new();
    for y in 0..=n {
        for x in 0..=n {
            let z = dice.below(40) as f64 * 0.01;
            positions.push(snapped(DVec3::new(f64::from(x), f64::from(y), z)));
        }
    }
    let mut faces = Vec::new();
    for y in 0..n {
        for x in 0..n {
            let a = y * (n + 1) + x;
            faces.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
        }
    }
    if wild {
        let count = positions.len();
        for _ in 0..n {
            let at = dice.below(faces.len());
            faces[at].swap(0, 1);
            let face = [0; 3].map(|_| dice.below(count) as u32);
            if face[0] != face[1] && face[1] != face[2] && face[2] != face[0] {
                faces.push(face);
            }
            let [a, b, _] = faces[dice.below(faces.len())];
            positions.push(snapped(DVec3::new(dice.below(50) as f64 * 0.3, 1.0, dice.below(50) as f64 * 0.2)));
            faces.push([a, b, positions.len() as u32 - 1]);
        }
        // One that no face uses.
        positions.push(DVec3::splat(7.0));
    }
    (positions, faces)
}

/// Collapses random edges, and now and then a pair without an edge; asks nobody whether that is wise.
fn random_sequence(seed: u64, n: u32, share: f64, wild: bool, half_edge: bool) -> Sequence {
    let mut dice = Dice(seed);
    let (positions, faces) = sheet(n, wild, &mut dice);
    let labels: Vec<ClassId> = faces.iter().map(|f| ClassId((f[0] / 40 % 4) as u8)).collect();
    let (mut at, mut now) = (positions.clone(), faces.clone());
    let mut alive: Vec<u32> = (0..at.len() as u32).collect();
    let (mut log, mut dead) = (CollapseLog::default(), vec![false; faces.len()]);
    for i in 0..(positions.len() as f64 * share) as usize {
        let lives = |(f, [a, b, c]): &(usize, &[u32; 3])| a != b && b != c && c != a && !dead[*f];
        let living: Vec<[u32; 3]> = now.iter().enumerate().filter(lives).map(|(_, f)| *f).collect();
        let (kept, gone) = if living.is_empty() || wild && dice.below(20) == 0 {
            (alive[dice.below(alive.len())], alive[dice.below(alive.len())])
        } else {
            let face = living[dice.below(living.len())];
            let k = dice.below(3);
            (face[k], face[(k + 1) % 3])
        };
        if kept == gone {
            continue;
        }
        if !half_edge {
            at[kept as usize] = snapped((at[kept as usize] + at[gone as usize]) * 0.5 + DVec3::splat(0.02));
        }
        alive.retain(|v| *v != gone);
        for face in &mut now {
            *face = face.map(|v| if v == gone { kept } else { v });
        }
        // Of faces folded onto each other all but one go, or all.
        let mut around: Vec<([u32; 3], usize)> = Vec::new();
        for (f, [a, b, c]) in now.iter().enumerate().filter(|(f, _)| !dead[*f]) {
            if [a, b, c].contains(&&kept) && a != b && b != c && c != a {
                let mut key = [*a, *b, *c];
                key.sort_unstable();
                around.push((key, f));
            }
        }
        around.sort_unstable();
        for same in around.chunk_by(|a, b| a.0 == b.0).filter(|g| g.len() > 1) {
            let stays = dice.below(2);
            for &(_, f) in &same[stays..] {
                dead[f] = true;
                log.folded.push((log.events.len() as u32, f as u32));
            }
        }
        let mut deviation_m = [0f32; MAX_CLASSES];
        deviation_m[dice.below(4)] = i as f32 * 0.001 + dice.below(10) as f32 * 0.001;
        let energy = i as f32 * 0.1 + dice.below(3) as f32;
        log.events.push(Collapse { kept, gone, position: at[kept as usize], energy });
        log.levels.push(deviation_m.map(|m| level_of(f64::from(m))));
    }
    Sequence { positions, faces, labels, grid_m: GRID_M, log }
}

/// The mesh after the first `events`, carried out one by one on the source: positions, corners, class.
fn collapsed(sequence: &Sequence, events: usize) -> Vec<([[u64; 3]; 3], u8)> {
    let mut at = sequence.positions.clone();
    let mut faces = sequence.faces.clone();
    for e in &sequence.log.events[..events] {
        at[e.kept as usize] = e.position;
        for face in &mut faces {
            *face = face.map(|v| if v == e.gone { e.kept } else { v });
        }
    }
    for &(_, f) in sequence.log.folded.iter().filter(|(e, _)| (*e as usize) < events) {
        faces[f as usize] = [0; 3];
    }
    let classes: Vec<u8> = sequence.labels.iter().map(|c| c.0).collect();
    canonical(&at, &faces, &classes)
}

/// Faces as positions, turned to begin at the least, in order: what is left when names are taken away.
fn canonical(at: &[DVec3], faces: &[[u32; 3]], classes: &[u8]) -> Vec<([[u64; 3]; 3], u8)> {
    let key = |v: u32| at[v as usize].to_array().map(|x| (x + 0.0).to_bits());
    let living = faces.iter().zip(classes).filter(|([a, b, c], _)| a != b && b != c && c != a);
    let mut all: Vec<_> = living
        .map(|(f, c)| {
            let [x, y, z] = f.map(key);
            ([[x, y, z], [y, z, x], [z, x, y]].into_iter().min().unwrap(), *c)
        })
        .collect();
    all.sort_unstable();
    all
}

fn about() -> About {
    About {
        origin: DVec3::new(400_000.0, 5_000_000.0, 12.5),
        scheme: ClassScheme::default(),
        method: "test".into(),
        tracked: true,
    }
}

fn opened(bytes: Vec<u8>) -> crate::Result<Record> {
    Record::open(Path::new("x.record"), bytes)
}

fn round_trip(sequence: &Sequence) -> (Record, Progressive) {
    let record = opened(encode(sequence.clone(), &about()).unwrap()).unwrap();
    let decoded = record.decode(usize::MAX).unwrap();
    (record, decoded)
}

fn check_valid(mesh: &Replayed) {
    assert_eq!(mesh.faces.len(), mesh.classes.len());
    for &[a, b, c] in &mesh.faces {
        assert!((a.max(b).max(c) as usize) < mesh.positions.len() && a != b && b != c && c != a);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn every_prefix_replays_bit_for_bit(seed: u64, n in 1u32..9, share in 0.0..1.0f64, wild: bool, half: bool) {
        let sequence = random_sequence(seed, n, share, wild, half);
        let (_, decoded) = round_trip(&sequence);
        let count = sequence.log.events.len();
        prop_assert_eq!(decoded.len(), count);
        for splits in (0..=count).rev().step_by(1 + count / 12) {
            let mesh = decoded.at(splits);
            check_valid(&mesh);
            prop_assert_eq!(mesh.faces.len(), decoded.faces_at(splits));
            let events = count - splits;
            prop_assert_eq!(canonical(&mesh.positions, &mesh.faces, &mesh.classes), collapsed(&sequence, events));
            for (class, bound) in mesh.bounds_m.iter().enumerate() {
                let worst = sequence.log.levels[..events].iter().map(|d| d[class]).max().unwrap_or(0);
                prop_assert_eq!(*bound, size_of(worst));
            }
        }
    }

    #[test]
    fn decoding_gives_the_sequence_back_but_for_names(seed: u64, n in 1u32..8, wild: bool) {
        let sequence = random_sequence(seed, n, 0.9, wild, false);
        let (_, decoded) = round_trip(&sequence);
        // The vertex that event i removed is the one that split (last - i) made; the base is named by what is left over.
        let count = sequence.log.events.len();
        let base = decoded.base_points.len();
        prop_assert_eq!(base, sequence.positions.len() - count);
        let mut name = vec![u32::MAX; sequence.positions.len()];
        for (i, e) in sequence.log.events.iter().enumerate() {
            name[e.gone as usize] = (base + count - 1 - i) as u32;
        }
        for (i, e) in sequence.log.events.iter().enumerate() {
            let split = count - 1 - i;
            let kept = name[e.kept as usize];
            prop_assert!(kept == decoded.kept[split] || kept == u32::MAX && (decoded.kept[split] as usize) < base);
            name[e.kept as usize] = decoded.kept[split];
            prop_assert_eq!(decoded.coarse_at[split], e.position);
            prop_assert_eq!(decoded.deviation[split], sequence.log.levels[i]);
        }
    }

    #[test]
    fn budgets_are_kept_and_a_budget_for_everything_is_the_base(seed: u64, n in 2u32..8, wild: bool, most in 0.0..0.2f64) {
        let sequence = random_sequence(seed, n, 0.9, wild, false);
        let (_, decoded) = round_trip(&sequence);
        let all = decoded.within(&[1e9; MAX_CLASSES]);
        prop_assert_eq!(
            canonical(&all.positions, &all.faces, &all.classes),
            collapsed(&sequence, sequence.log.events.len())
        );
        let none = decoded.within(&[-1.0; MAX_CLASSES]);
        prop_assert_eq!(canonical(&none.positions, &none.faces, &none.classes), collapsed(&sequence, 0));
        let mut budgets = [0.1; MAX_CLASSES];
        budgets[1] = most;
        let some = decoded.within(&budgets);
        check_valid(&some);
        prop_assert!(some.bounds_m.iter().zip(budgets).all(|(b, most)| *b <= most));
    }

    #[test]
    fn nonsense_under_right_checksums_is_an_error_or_a_valid_mesh(seed: u64, cut in 0usize..3) {
        let sequence = random_sequence(seed, 6, 0.8, true, false);
        let record = opened(encode(sequence.clone(), &about()).unwrap()).unwrap();
        let mut dice = Dice(seed ^ 0x55);
        let (header, mut parts) = record.taken_apart();
        for _ in 0..3 {
            let part = dice.below(parts.len());
            let at = dice.below(parts[part].len());
            parts[part][at] ^= 1 << dice.below(8);
        }
        if cut > 0 {
            let part = dice.below(parts.len());
            let length = dice.below(parts[part].len());
            parts[part].truncate(length);
        }
        if let Ok(decoded) = opened(file::Layout::write(&header, parts.clone())).and_then(|r| r.decode(usize::MAX)) {
            for splits in 0..=decoded.len() {
                check_valid(&decoded.at(splits));
            }
            check_valid(&decoded.within(&[0.03; MAX_CLASSES]));
        }
    }
}

#[test]
fn any_byte_flipped_is_an_error() {
    let bytes = encode(random_sequence(5, 4, 0.7, true, false), &about()).unwrap();
    for at in 0..bytes.len() {
        for bit in [0, 3, 7] {
            let mut broken = bytes.clone();
            broken[at] ^= 1 << bit;
            let result = opened(broken).and_then(|r| r.decode(usize::MAX));
            let error = result.expect_err("a byte was flipped");
            assert_eq!(error.exit_code(), 3, "{error}");
            assert!(error.to_string().starts_with("x.record"), "{error}");
        }
    }
}

#[test]
fn any_cut_and_any_tail_is_an_error() {
    let bytes = encode(random_sequence(6, 4, 0.7, false, true), &about()).unwrap();
    for end in 0..bytes.len() {
        assert!(opened(bytes[..end].to_vec()).is_err(), "cut to {end} bytes");
    }
    let mut long = bytes;
    long.push(0);
    assert!(opened(long).unwrap_err().to_string().contains("after its end"));
}

#[test]
fn sizes_that_the_file_cannot_hold_are_refused_before_anything_is_made_of_them() {
    let record = opened(encode(random_sequence(7, 4, 0.7, false, false), &about()).unwrap()).unwrap();
    let (header, parts) = record.taken_apart();
    let spoil: [fn(&mut Header); 5] = [
        |h| h.chunks[0].faces = u32::MAX,
        |h| h.chunks[0].vertices = 1 << 30,
        |h| h.chunks[1].events = 1 << 30,
        |h| h.chunks.iter_mut().for_each(|c| c.faces = 4_000_000),
        |h| h.about.scheme.0.clear(),
    ];
    for change in spoil {
        let mut header = header.clone();
        change(&mut header);
        let error = opened(file::Layout::write(&header, parts.clone())).unwrap_err();
        assert!(error.to_string().contains("the header says"), "{error}");
    }
}

#[test]
fn fewer_chunks_are_the_coarse_meshes_of_the_whole() {
    let sequence = random_sequence(11, 12, 0.9, true, false);
    let (record, whole) = round_trip(&sequence);
    let chunks = &record.header().chunks;
    assert!(chunks.len() > 3, "octaves make chunks");
    for (count, info) in chunks.iter().enumerate() {
        let part = record.decode(count).unwrap();
        let splits = info.vertices as usize - whole.base_points.len();
        assert_eq!(part.at(usize::MAX), whole.at(splits));
        assert_eq!(info.bounds.map(size_of), whole.at(splits).bounds_m);
        assert_eq!(part.faces.len(), info.faces as usize);
    }
}

#[test]
fn the_coarsest_mesh_within_limits_is_found_from_any_part() {
    let (record, whole) = round_trip(&random_sequence(12, 12, 0.9, false, false));
    for limit in [0.0, 0.011, 0.05, 0.1, 1.0] {
        let limits = [limit; MAX_CLASSES];
        let splits = whole.splits_within(&limits).unwrap();
        assert!(whole.at(splits).bounds_m.iter().all(|b| *b <= limit));
        assert!(splits == 0 || whole.at(splits - 1).bounds_m.iter().any(|b| *b > limit));
        let chunks = record.chunks_within(&limits).unwrap();
        assert_eq!(record.decode(chunks).unwrap().splits_within(&limits), Some(splits));
        let chosen = record.decode(chunks).unwrap().within(&limits);
        let all = whole.within(&limits);
        assert_eq!(
            canonical(&chosen.positions, &chosen.faces, &chosen.classes),
            canonical(&all.positions, &all.faces, &all.classes)
        );
    }
}

#[test]
fn without_tracking_nothing_is_said_of_errors() {
    let sequence = random_sequence(13, 8, 0.8, false, true);
    let untracked = About { tracked: false, ..about() };
    let record = opened(encode(sequence.clone(), &untracked).unwrap()).unwrap();
    assert!(!record.header().about.tracked);
    let decoded = record.decode(usize::MAX).unwrap();
    assert_eq!(decoded.splits_within(&[1e9; MAX_CLASSES]), None);
    assert_eq!(record.chunks_within(&[1e9; MAX_CLASSES]), None);
    assert!(decoded.deviation.iter().flatten().all(|level| *level == 0));
    let mesh = decoded.at(0);
    let all = sequence.log.events.len();
    assert_eq!(canonical(&mesh.positions, &mesh.faces, &mesh.classes), collapsed(&sequence, all));
}

#[test]
fn a_position_off_the_grid_or_an_event_of_a_lost_vertex_is_our_bug() {
    let mut sequence = random_sequence(1, 3, 0.5, false, false);
    sequence.log.events[1].position.x += 1e-4;
    assert_eq!(encode(sequence.clone(), &about()).unwrap_err().exit_code(), 7);
    let mut sequence = random_sequence(1, 3, 0.5, false, false);
    sequence.log.events[2].kept = sequence.log.events[0].gone;
    assert_eq!(encode(sequence.clone(), &about()).unwrap_err().exit_code(), 7);
}

#[test]
fn a_hub_of_many_faces_goes_there_and_back() {
    let mut positions = vec![DVec3::ZERO];
    let n = 200;
    positions.extend((0..n).map(|i| snapped(DVec3::new(f64::from(i).cos(), f64::from(i).sin(), 0.1) * 50.0)));
    let faces: Vec<[u32; 3]> = (0..n).map(|i| [0, 1 + i, 1 + (i + 1) % n]).collect();
    let events = (0..150)
        .map(|i| Collapse { kept: 2 + i, gone: 1 + i, position: positions[2 + i as usize], energy: 1.0 })
        .collect();
    let labels = vec![ClassId(1); faces.len()];
    let log = CollapseLog { events, ..CollapseLog::default() };
    let sequence = Sequence { positions, faces, labels, grid_m: GRID_M, log };
    let (_, decoded) = round_trip(&sequence);
    for splits in 0..=150 {
        let mesh = decoded.at(splits);
        assert_eq!(canonical(&mesh.positions, &mesh.faces, &mesh.classes), collapsed(&sequence, 150 - splits));
    }
}
