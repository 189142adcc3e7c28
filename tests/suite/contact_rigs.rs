//! Rigs whose contact pairs open and close with the load (`[contact_state]`): states and roots against scipy
//! (`tests/peers/contact_rigs.py`), both kinds of rig, what is refused, and sessions from a recording to its replay.

use std::path::Path;
use std::process::Command;

use crate::identify::targets_at_loads;
use crate::program::side::{Side, archive};
use crate::program::{self, folder, json, launch, number, python, rig_file as file, run, text, write};
use faer::c64;
use serde_json::{Value, json};
use squealcast::physics::{OperatingPoint, Solver, Vectors};
use squealcast::proof::held_out::hold_out;
use squealcast::rig::{Rig, RigFile};
use squealcast::session::chart_options;
use squealcast::session::computed::session_chart;

fn point(normal_load_n: f64, disc_speed_rad_s: f64, friction_coefficient: f64) -> OperatingPoint {
    OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient }
}

/// `rough-pad` with other contents of `[contact_state]`, and pairs with stiffness and damping.
fn with_law(keys: &str) -> String {
    let rig = std::fs::read_to_string(launch("rough-pad.toml")).unwrap();
    let (head, rest) = rig.split_once("[contact_state]\n").unwrap();
    let (_, tail) = rest.split_once("\n\n").unwrap();
    let pair = "[[contact]]\nstiffness_n_per_m = 3e7\ndamping_n_s_per_m = 20.0\n";
    format!("{head}[contact_state]\nload_pad = [0.0, -1.0, 0.0]\n{keys}\n\n{}", tail.replace("[[contact]]\n", pair))
}

const LINEAR: &str = "law = \"linear\"\nmeasured = \"back-force\"\ngap_m = [3e-6, 1e-6, 5e-7, 0.0, 5e-7, 1e-6, 3e-6]";

/// Laws of every kind that needs no table.
fn laws() -> Vec<String> {
    let power = |more: &str| format!("law = \"power\"\nreference_m = 2e-6\n{more}");
    vec![
        std::fs::read_to_string(launch("rough-pad.toml")).unwrap(),
        with_law(LINEAR),
        with_law(&LINEAR.replace("back", "contact")),
        with_law(&power("exponent = 2.0\nmeasured = \"back-force\"\ngap_m = 1e-6")),
        with_law(&power("exponent = 1.5\nroughness_m = 5e-7\nmeasured = \"contact-force\"")),
        with_law(
            "law = \"exponential\"\npressure_pa = 2e4\nroughness_m = 1.5e-6\nmeasured = \"contact-force\"\n\
             area_m2 = [1e-4, 2e-4, 3e-4, 2e-4, 2e-4, 2e-4, 1e-4]\ngap_m = [2e-6, 0.0, 0.0, 0.0, 0.0, 0.0, 2e-6]",
        ),
    ]
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().expect("numbers").iter().map(|x| x.as_f64().expect("a number")).collect()
}

/// Forces are known to 1e-11 of the largest, and so is the stiffness they give; roots follow with the condition of a flutter
/// pair, here below 100.
#[test]
fn scipy_finds_the_states_and_roots_of_rig_files() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let mut cases = vec![];
    for rig in laws() {
        for p in [point(500.0, 13.0, 0.0), point(500.0, 13.0, 0.4), point(150.0, -13.0, 0.3), point(2000.0, 4.0, 0.6)] {
            let OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient } = p;
            let input =
                json!({ "rig": rig, "load": normal_load_n, "speed": disc_speed_rad_s, "mu": friction_coefficient });
            cases.push((p, input));
        }
    }
    let folder = folder();
    let inputs: Vec<&Value> = cases.iter().map(|(_, input)| input).collect();
    let path = write(folder.path(), "cases.json", &serde_json::to_string(&inputs).unwrap());
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/contact_rigs.py");
    let output = Command::new(&python).arg(script).arg(&path).output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let (mut force_off, mut root_off, mut open, mut growing) = (0.0f64, 0.0f64, 0, 0);
    for (k, ((p, input), expected)) in cases.iter().zip(found["cases"].as_array().expect("cases")).enumerate() {
        let at = format!("case {k} at {p:?}");
        let rig = Rig::from_files(&[file("rig.toml", input["rig"].as_str().unwrap())]).unwrap();
        let spectrum = Solver::new(rig.model.dimension()).solve(&rig.model, p, Vectors::Both).expect("it solves");
        let state = spectrum.state.as_ref().expect("the contact is loaded");
        let forces = numbers(&expected["force_n"]);
        let largest = forces.iter().copied().fold(0.0, f64::max);
        assert_eq!(state.force_n.len(), forces.len(), "{at}");
        for (found, expected) in state.force_n.iter().zip(&forces) {
            assert_eq!(*found > 0.0, *expected > 0.0, "{at}: {found} N, {expected} N");
            force_off = force_off.max((found - expected).abs() / largest);
        }
        open += forces.iter().filter(|force| **force == 0.0).count();
        let roots: Vec<c64> = spectrum.modes().iter().map(|root| root.lambda).collect();
        let mut others: Vec<c64> = expected["roots"]
            .as_array()
            .expect("roots")
            .iter()
            .map(|z| c64::new(numbers(z)[0], numbers(z)[1]))
            .collect();
        assert_eq!(roots.len(), others.len(), "{at}: {roots:?} {others:?}");
        for root in roots {
            let off = |z: &c64| (z - root).norm();
            let nearest = (0..others.len()).min_by(|&a, &b| off(&others[a]).total_cmp(&off(&others[b])));
            let other = others.swap_remove(nearest.expect("as many roots"));
            growing += usize::from(other.re > 0.0);
            root_off = root_off.max(off(&other) / root.norm());
        }
    }
    eprintln!(
        "{} cases, with {}: forces off by {force_off:.1e}, roots by {root_off:.1e}; {open} pairs open, {growing} modes grow",
        cases.len(),
        found["versions"]
    );
    assert!(force_off < 1e-10 && root_off < 1e-9, "{force_off:e} {root_off:e}");
    assert!(open >= 5 && growing >= 8, "worth comparing: {open} open, {growing} growing");
}

/// A table that is read off an exponential law gives its forces: 40 points over 8 roughness heights are interpolated to 1e-3.
#[test]
fn a_table_gives_the_forces_of_the_law_it_was_read_off() {
    let exponential = Rig::load(&launch("rough-pad.toml")).unwrap();
    let rows: String = (0..40)
        .map(|k| 0.2 * f64::from(k) * 2e-6 - 2e-6)
        .map(|closure| format!("{closure:e},{:e}\n", 1e4 * (closure / 2e-6).exp()))
        .collect();
    let rig = with_law("law = \"table\"\ntable = \"pad.csv\"\narea_m2 = 0.000214285714286\nmeasured = \"back-force\"");
    let table = format!("closure_m, pressure_pa\n{rows}");
    let rig = Rig::from_files(&[file("rig.toml", rig.as_str()), file("pad.csv", table.as_str())]).unwrap();
    for p in [point(100.0, 13.0, 0.3), point(500.0, 13.0, 0.4), point(800.0, -13.0, 0.2)] {
        let [found, expected] = [&rig, &exponential].map(|rig| rig.model.at(&p).unwrap().state().unwrap().clone());
        for (found, expected) in found.force_n.iter().zip(&expected.force_n) {
            assert!((found / expected - 1.0).abs() < 1e-3, "{p:?}: {found} N, {expected} N");
        }
    }
    // Beyond its last point a table is not continued.
    let beyond = rig.model.at(&point(5e4, 13.0, 0.1)).unwrap_err().to_string();
    assert!(beyond.contains("beyond the last closure of the table"), "{beyond}");
}

/// Generalised force of 1 N against the normal z, spread over the nodes.
fn load(side: &Side) -> Vec<f64> {
    let share = 1.0 / side.nodes.len() as f64;
    let of_mode = |mode: usize| -(0..side.nodes.len()).map(|node| share * side.phi[3 * node + 2][mode]).sum::<f64>();
    (0..side.omega.len()).map(of_mode).collect()
}

/// Motion of each node along z by the modes from `kept` on, under a load of 1 N.
fn truncated_gap(side: &Side, kept: usize) -> Vec<f64> {
    let load = load(side);
    let rest = kept..side.omega.len();
    let of_node =
        |node: usize| rest.clone().map(|k| side.phi[3 * node + 2][k] * load[k] / side.omega[k].powi(2)).sum::<f64>();
    (0..side.nodes.len()).map(of_node).collect()
}

/// An archive of the first `kept` modes with the load on them, and both residuals of the rest if requested.
fn loaded(side: &Side, kept: usize, residual: bool) -> Vec<u8> {
    let mut arrays = side.arrays(kept, residual, residual);
    arrays.push(("load", vec![kept as u64], load(side)[..kept].to_vec()));
    archive(&arrays)
}

fn pad() -> Side {
    let nodes = vec![[0.10, 0.0, 0.01], [0.108, 0.0, 0.01], [0.10, 0.008, 0.01], [0.109, 0.008, 0.01]];
    Side::new(nodes, 9, 900.0, 0.3)
}

fn disc() -> Side {
    let at = |i: usize, j: usize| [0.09 + 0.01 * i as f64, -0.008 + 0.008 * j as f64, 0.01];
    Side::new((0..4).flat_map(|i| (0..3).map(move |j| at(i, j))).collect(), 8, 1300.0, 1.1)
}

/// A rig of kind 2; `more` are further keys of `[contact_state]`, `keys` of `[pad]`.
fn modal(keys: &str, more: &str, pad: Vec<u8>, disc: Vec<u8>) -> [RigFile; 3] {
    let toml = format!(
        "name = \"modal\"\n[band]\nmax_hz = 100.0\n[pad]\nmodal = \"pad.npz\"\n{keys}\n[disc]\nmodal = \"disc.npz\"\n\
         [contact_state]\nlaw = \"linear\"\nmeasured = \"back-force\"\ngap_m = [0.0, 1e-5, 2e-5, 3e-5]\n{more}\n\
         [[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 0.0, 1.0]\nnormal = [0.0, 0.0, 1.0]\n\
         stiffness_n_per_m = 2e6\n"
    );
    [file("modal.toml", toml.as_str()), file("pad.npz", pad), file("disc.npz", disc)]
}

/// Statics need no more modes than those with a residual flexibility that holds the rest, with the response of the gaps to
/// the load: all modes, some with the residual of the others, and all with a selection of them give the same forces.
#[test]
fn truncated_modes_keep_their_static_response() {
    let (pad, disc) = (pad(), disc());
    let gaps = |kept: usize| format!("residual_gap_m_per_n = {:?}", truncated_gap(&pad, kept));
    let in_file = format!("load_coordinates = {:?}", load(&pad));
    let all = modal("", &in_file, pad.archive(9, false, false), disc.archive(8, false, false));
    let reduced = modal("", &gaps(5), loaded(&pad, 5, true), disc.archive(4, true, true));
    let selected = modal("modes = 5", &gaps(9), loaded(&pad, 9, true), disc.archive(4, true, true));
    let [all, reduced, selected] = [all, reduced, selected].map(|files| Rig::from_files(&files).unwrap());
    assert!(reduced.describe().contains("without the inertial term, which a contact state does not use"));
    let mut open = 0;
    for p in [point(300.0, 13.0, 0.0), point(300.0, 13.0, 0.5), point(150.0, -13.0, 0.4), point(900.0, 13.0, 0.2)] {
        let forces = |rig: &Rig| rig.model.at(&p).unwrap().state().unwrap().force_n.clone();
        let expected = forces(&all);
        let largest = expected.iter().copied().fold(0.0, f64::max);
        for (name, rig) in [("reduced", &reduced), ("selected", &selected)] {
            for (found, expected) in forces(rig).iter().zip(&expected) {
                assert!((found - expected).abs() <= 1e-10 * largest, "{name} at {p:?}: {found} N, {expected} N");
            }
        }
        open += expected.iter().filter(|force| **force == 0.0).count();
    }
    assert!(open > 0 && open < 15, "{open} pairs open");
    // A picture places the pairs along the motion of the disc, +y at the pad, and outward from its axis.
    let p = point(300.0, 13.0, 0.5);
    let shown = squealcast::display::contact::contact(&selected, &p).unwrap();
    assert_eq!(shown.force_n, selected.model.at(&p).unwrap().state().unwrap().force_n);
    assert_eq!(shown.places.len(), pad.nodes.len());
    let middle = [0.10425, 0.004];
    let height = f64::hypot(middle[0], middle[1]);
    for (node, place) in pad.nodes.iter().zip(&shown.places) {
        let along = (middle[0] * node[1] - middle[1] * node[0]) / height;
        let outward = (middle[0] * node[0] + middle[1] * node[1]) / height - height;
        assert!((place.along_m - along).abs() < 1e-15 && (place.outward_m - outward).abs() < 1e-15, "{place:?}");
    }
    // Without the response of the truncated modes to the load the forces differ.
    let without = modal("", "residual_gap_m_per_n = 0.0", loaded(&pad, 5, true), disc.archive(4, true, true));
    let without = Rig::from_files(&without).unwrap();
    let p = point(300.0, 13.0, 0.5);
    let total = |rig: &Rig| rig.model.at(&p).unwrap().state().unwrap().contact_force_n();
    assert!((total(&without) / total(&all) - 1.0).abs() > 1e-3);
}

/// A full model whose pairs are always closed says nothing about a rig whose pairs open.
#[test]
fn a_rig_with_a_contact_state_is_not_verified_against_closed_pairs() {
    run(["verify", "rough-pad", "--against", &launch("hulten.toml"), "--points", "1"])
        .exits(1)
        .complains("rough-pad: `contact_state` is given, but the pairs of hulten are always closed")
        .complains("expected it in both or neither");
}

#[test]
fn contact_states_that_make_no_sense_are_refused() {
    let refused = |rig: &str, expected: &str| {
        let files = [file("x.toml", rig), file("bad.csv", "closure_m,pressure_pa\n0,1\n1e-6,zwei\n")];
        let error = Rig::from_files(&files).map(|_| ()).unwrap_err().to_string();
        assert!(error.starts_with("x.toml") || error.starts_with("bad.csv"), "{error}");
        assert!(error.contains(expected), "{error}\nexpected: {expected}");
    };
    let change = |from: &str, to: &str, expected: &str| {
        let rig = with_law("law = \"power\"\nexponent = 2.0\nreference_m = 2e-6\nmeasured = \"back-force\"");
        assert!(rig.contains(from), "{from}");
        refused(&rig.replace(from, to), expected);
    };
    change(
        "\"power\"",
        "\"soft\"",
        "`contact_state.law` is \"soft\", expected \"linear\", \"power\", \"exponential\" or",
    );
    change("back-force", "load", "`contact_state.measured` is \"load\", expected \"contact-force\" or \"back-force\"");
    change("measured", "# measured", "`measured` is missing");
    change("exponent = 2.0", "", "`contact_state.exponent` is missing; expected it for the law \"power\"");
    change("exponent = 2.0", "exponent = 0.5", "`contact_state.exponent` is 0.5, expected 1 to 10");
    change("reference_m = 2e-6", "reference_m = 0", "`contact_state.reference_m` is 0, expected more than 0");
    change("reference_m = 2e-6", "reference_m = nan", "`contact_state.reference_m` is NaN, expected a finite number");
    let rounded = "reference_m = 2e-6\nroughness_m = -1e-6";
    change("reference_m = 2e-6", rounded, "`contact_state.roughness_m` is -0.000001, expected at least 0");
    let acting =
        "`contact_state.pressure_pa` has nothing to act on in the law \"power\"; expected exponent, reference_m";
    change("reference_m = 2e-6", "reference_m = 2e-6\npressure_pa = 1.0", acting);
    change("stiffness_n_per_m = 3e7\n", "", "`stiffness_n_per_m of contact pair 0` is 0, expected more than 0");
    let gaps = "`contact_state.gap_m` has shape 2, expected one value or one for each of 7 contact pairs";
    change("exponent =", "gap_m = [0.0, 1.0]\nexponent =", gaps);
    let row = "`contact_state.load_pad` has shape 1 values, expected one for each of 3 degrees of freedom";
    change("load_pad = [0.0, -1.0, 0.0]", "load_pad = [1.0]", row);
    change("load_pad = [0.0, -1.0, 0.0]\n", "", "`contact_state.load_pad` is missing");
    let pulls = "changes the contact force by 0 N per N at 500 N, expected more than 0: a load that presses the pad";
    change("load_pad = [0.0, -1.0, 0.0]", "load_pad = [0.0, 1.0, 0.0]", pulls);
    change("load_pad", "load_coordinates = [1.0]\nload_pad", "`contact_state.load_coordinates` is given for inline");
    change("load_pad", "residual_gap_m_per_n = 0.0\nload_pad", "inline substructures have no residual flexibility");
    change("[search]", "[load]\nexponent = 0.3\n[search]", "[load] exponent 0.3 with a contact state, expected 0");
    let table = |keys: &str| with_law(&format!("law = \"table\"\narea_m2 = 1e-4\nmeasured = \"back-force\"\n{keys}"));
    refused(&table("table = \"none.csv\""), "contact_state.table = \"none.csv\" cannot be read");
    refused(&table("table = \"bad.csv\""), "bad.csv, line 3: point is `1e-6,zwei`; expected two finite numbers");
    let exponential = "law = \"exponential\"\npressure_pa = 1e4\nroughness_m = 2e-6\nmeasured = \"back-force\"";
    refused(&with_law(exponential), "`contact_state.area_m2` is missing; expected it for the law \"exponential\"");

    let modal_refused = |more: &str, residual: bool, with_load: bool, expected: &str| {
        let pad = if with_load { loaded(&pad(), 5, residual) } else { pad().archive(5, residual, residual) };
        let files = modal("", more, pad, disc().archive(4, residual, residual));
        let error = Rig::from_files(&files).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}\nexpected: {expected}");
    };
    modal_refused("", false, false, "`contact_state.load_coordinates` is missing; expected one value for each mode");
    modal_refused(
        "load_coordinates = [1.0]",
        false,
        false,
        "has shape 1, expected one value or one for each of 5 modes",
    );
    modal_refused("load_coordinates = [1.0]", false, true, "is given beside the array `load` of pad.modal");
    modal_refused("load_pad = [1.0]", false, true, "`contact_state.load_pad` is given for modal substructures");
    modal_refused("", true, true, "`contact_state.residual_gap_m_per_n` is missing");
    modal_refused("residual_gap_m_per_n = 0.0", false, true, "the rig has no residual flexibility");
}

/// What a rig assumes about its contact is part of its description.
#[test]
fn check_says_what_a_rig_assumes_about_its_contact() {
    run(["check", "nine-dof"]).exits(0).says("state      every pair always closed: springs that push and pull");
    run(["check", "rough-pad"])
        .exits(0)
        .says("contact    7 pairs, in all 1.500000e-3 m²")
        .says("law        exponential, 1e4 Pa at closure 0, roughness height 2e-6 m; the load is the force on the pad's back")
        .says("state      7 pairs: 7 closed at 500 N without friction, 7 closed at friction coefficient 0.4");
    let folder = folder();
    let rig = write(folder.path(), "opening.toml", &with_law(LINEAR));
    run(["check", &rig])
        .exits(0)
        .says("linear springs that only push")
        .says("7 closed at 500 N without friction, 6 closed");
}

/// A rig of one mass that jams: `K_0 = [1.5 0.75; 0.75 0.5]`, contact spring 4/3 on the second coordinate. With reversed
/// sliding `det(K_0 + (n + s μ t) k nᵀ)` vanishes at `μ = (0.1875 + 1.5 k) / (0.75 k) = 2.1875`.
fn jamming() -> String {
    let rig = std::fs::read_to_string(launch("hoffmann.toml")).unwrap();
    let (head, tail) = rig.split_once("[pad]").unwrap();
    format!(
        "{head}[search]\nmu_max = 3.0\n[limits]\nfriction_coefficient = [0.0, 3.0]\n[contact_state]\nlaw = \"linear\"\n\
         measured = \"back-force\"\nload_pad = [0.0, 1.0]\n[pad]{tail}"
    )
}

/// Where the pad jams, predictions are faults that say why; the session replays to the same bits.
#[test]
fn a_pad_that_jams_is_a_fault_with_its_reason() {
    let folder = folder();
    let rig = write(folder.path(), "jamming.toml", &jamming());
    run(["predict", &rig, "--mu", "2.2", "--speed", "-13"]).exits(1).complains("the pad jams at 2.187500");
    run(["predict", &rig, "--mu", "2.1", "--speed", "-13"]).exits(0);
    run(["critical", &rig, "--speed", "-13"])
        .exits(0)
        .says("no steady sliding beyond friction coefficient 2.187")
        .says("the pad jams at 2.187500");
    let profile = "[[point]]\ntime_s = 0.0\nnormal_load_n = 50.0\ndisc_speed_rad_s = -13.0\nfriction_coefficient = 2.0\n\
                   [[point]]\ntime_s = 2.0\nnormal_load_n = 90.0\ndisc_speed_rad_s = -13.0\nfriction_coefficient = 2.4\n";
    let profile = write(folder.path(), "rising.toml", profile);
    let out = text(folder.path());
    run(["simulate", "--profile", &profile, "--rig", &rig, "--rate", "25", "--duration", "2", "--record", &out])
        .exits(0);
    let recorded: Vec<_> = program::files_below(folder.path())
        .into_iter()
        .filter(|path| path.extension().is_some_and(|e| e == "mcap"))
        .collect();
    let verified = run(["replay", "--verify", &text(&recorded[0])]).exits(0);
    verified.says("50 predictions identical, 0 different, 0 missing, 0 extra");
    let report = text(&folder.path().join("report"));
    run(["report", &text(&recorded[0]), "-o", &report]).exits(0);
    let report = std::fs::read_to_string(Path::new(&report).join("report.html")).unwrap();
    assert!(report.contains("the pad jams at 2.187500"), "the fault is reported with its reason");
}

/// A recorded session of a rig with a moving load replays to the same bits, from the rig file that it carries.
#[test]
fn a_session_with_a_moving_load_replays_to_the_same_bits() {
    let folder = folder();
    for (name, rig) in
        [("rough", launch("rough-pad.toml")), ("opening", write(folder.path(), "x.toml", &with_law(LINEAR)))]
    {
        let profile = "[[point]]\ntime_s = 0.0\nnormal_load_n = 200.0\ndisc_speed_rad_s = 13.0\nfriction_coefficient = 0.35\n\
                       [[point]]\ntime_s = 3.0\nnormal_load_n = 1200.0\ndisc_speed_rad_s = 9.0\nfriction_coefficient = 0.45\n\
                       [noise]\nnormal_load_n = 5.0\nfriction_coefficient = 0.01\n";
        let profile = write(folder.path(), "rising.toml", profile);
        let out = text(&folder.path().join(name));
        run(["simulate", "--profile", &profile, "--rig", &rig, "--rate", "20", "--duration", "3", "--record", &out])
            .exits(0);
        run(["replay", "--verify", &out]).exits(0).says("60 predictions identical, 0 different, 0 missing, 0 extra");
    }
}

#[test]
fn identification_scales_laws_with_a_stiffness() {
    let folder = folder();
    let rig = write(folder.path(), "linear.toml", &with_law(LINEAR));
    let stiffer = write(folder.path(), "stiffer.toml", &with_law(LINEAR).replace("= 3e7", "= 4.5e7"));
    let modes = json(["predict", &stiffer, "--mu", "0", "--speed", "0", "--json"]);
    let hz: Vec<String> =
        modes["modes"].as_array().unwrap().iter().map(|mode| number(mode, "frequency_hz").to_string()).collect();
    let targets = write(folder.path(), "targets.csv", &format!("frequency_hz\n{}\n", hz.join("\n")));
    let fitted = text(&folder.path().join("fitted.toml"));
    let found = json(["identify", &rig, "--targets", &targets, "--json", "-o", &fitted]);
    let factor = number(&found, "stiffness_factor");
    assert!((factor - 1.5).abs() < 1e-6, "{found}");
    let again = json(["predict", &fitted, "--json"]);
    let expected = json(["predict", &stiffer, "--json"]);
    let force = |value: &Value| number(&value["contact"], "contact_force_n");
    assert!((force(&again) / force(&expected) - 1.0).abs() < 1e-6);
}

/// Of an exponential law the roughness height is identified, from the frequencies of a rig with another one.
#[test]
fn identification_finds_the_roughness_height() {
    let folder = folder();
    let rough = std::fs::read_to_string(launch("rough-pad.toml")).unwrap();
    let smoother = write(folder.path(), "smoother.toml", &rough.replace("roughness_m = 2e-6", "roughness_m = 1.6e-6"));
    let modes = json(["predict", &smoother, "--mu", "0", "--speed", "0", "--json"]);
    let hz: Vec<String> =
        modes["modes"].as_array().unwrap().iter().map(|mode| number(mode, "frequency_hz").to_string()).collect();
    let targets = write(folder.path(), "targets.csv", &format!("frequency_hz\n{}\n", hz.join("\n")));
    let fitted = text(&folder.path().join("fitted.toml"));
    let found = json(["identify", "rough-pad", "--targets", &targets, "--json", "-o", &fitted]);
    // A minimum at which the error is 0 is as accurate as the final bracket.
    assert!((number(&found, "stiffness_factor") - 1.25).abs() < 1e-6, "{found}");
    let table: toml::Table = std::fs::read_to_string(&fitted).unwrap().parse().unwrap();
    let height = table["contact_state"]["roughness_m"].as_float().unwrap();
    assert!((height / 1.6e-6 - 1.0).abs() < 1e-6, "{height:e}");
    // A table has nothing to scale.
    write(folder.path(), "pad.csv", "closure_m,pressure_pa\n0,0\n1e-6,1e5\n1e-5,2e6\n1e-4,1e8\n");
    let rig = with_law("law = \"table\"\ntable = \"pad.csv\"\narea_m2 = 0.000214285714286\nmeasured = \"back-force\"");
    run(["identify", &write(folder.path(), "table.toml", &rig), "--targets", &targets]).exits(1).complains(
        "`contact_state.law` is \"table\", in which no stiffness can be changed; expected linear, power or exponential",
    );
}

/// Of a power law stiffness and exponent of the closure are identified, from the frequencies at several loads.
#[test]
fn identification_finds_the_exponent_of_a_power_law() {
    let folder = folder();
    let power = |exponent: &str| {
        with_law(&format!("law = \"power\"\nreference_m = 2e-6\nexponent = {exponent}\nmeasured = \"back-force\""))
    };
    let rig = write(folder.path(), "rig.toml", &power("2.0"));
    let made = write(folder.path(), "made.toml", &power("1.5").replace("= 3e7", "= 4.5e7"));
    let targets = targets_at_loads(folder.path(), &made, &[100.0, 400.0, 1500.0]);
    let found = json(["identify", &rig, "--targets", &targets, "--json"]);
    assert!((number(&found, "stiffness_factor") - 1.5).abs() < 1e-6, "{found}");
    assert!((number(&found, "exponent") - 1.5).abs() < 1e-6, "{found}");
    // An exponential law has one parameter only, which serves all loads.
    let rough = std::fs::read_to_string(launch("rough-pad.toml")).unwrap();
    let smoother = write(folder.path(), "smoother.toml", &rough.replace("roughness_m = 2e-6", "roughness_m = 1.6e-6"));
    let targets = targets_at_loads(folder.path(), &smoother, &[100.0, 1500.0]);
    let found = json(["identify", "rough-pad", "--targets", &targets, "--json"]);
    assert!((number(&found, "stiffness_factor") - 1.25).abs() < 1e-6 && found.get("exponent").is_none(), "{found}");
}

/// The load alone decides whether the rig squeals: at a friction coefficient of 0.4 it does at 500 N, and not at 100, 1000 and
/// 2000 N. The growth rate is scipy's, see above.
#[test]
fn the_load_opens_and_closes_a_window() {
    let growth = |load: &str| {
        let found = json(["predict", "rough-pad", "--load", load, "--mu", "0.4", "--json"]);
        let contact = &found["contact"];
        let forces = numbers(&contact["force_n"]);
        assert_eq!((number(contact, "pairs"), number(contact, "pairs_closed")), (7.0, 7.0));
        assert!((forces.iter().sum::<f64>() / number(contact, "contact_force_n") - 1.0).abs() < 1e-14);
        number(&found, "max_growth_rate_per_s")
    };
    assert!((growth("500") - 288.17).abs() < 0.01, "{}", growth("500"));
    for load in ["100", "1000", "2000"] {
        let rate = growth(load);
        assert!(rate < -1.0, "{rate} 1/s at {load} N");
    }
    let critical = |load: &str| number(&json(["critical", "rough-pad", "--load", load, "--json"]), "critical_friction");
    let found = ["100", "500", "2000"].map(critical);
    eprintln!("critical friction coefficients at 100, 500 and 2000 N: {found:?}");
    assert!(found[1] < 0.4 && found[0] > 0.4 && found[2] > 0.4, "{found:?}");
}

/// With an analytic law the chart serves, except where its leaves would be too small (4 of these 1000 conditions). With
/// springs that only push, roots jump where a pair opens: leaves end there, and conditions nearest to it are solved.
#[test]
fn charts_over_the_load_hold_their_bounds() {
    let rough = Rig::load("rough-pad").unwrap();
    let opening = Rig::from_files(&[file("x.toml", with_law(LINEAR))]).unwrap();
    for (rig, fewest) in [(rough, 990), (opening, 900)] {
        let options = chart_options(&rig);
        let chart = session_chart(&rig, 2, &|| true).expect("it can be charted");
        let found = hold_out(&rig.model, &options, &chart, 1000, 5).expect("it is solved");
        eprintln!("{} leaves, {} solves: {found:?}", chart.leaf_count(), chart.solve_count());
        assert_eq!((found.violations, found.incomplete), (0, 0), "{found:?}");
        assert!(found.charted >= fewest, "{found:?}");
        assert!(found.largest_error < 1e-7, "{found:?}");
    }
}

/// Values of the columns of a CSV table, by name.
fn table(csv: &str) -> Vec<std::collections::BTreeMap<String, String>> {
    let mut lines = csv.lines();
    let names: Vec<String> = lines.next().expect("a header").split(',').map(str::to_owned).collect();
    lines.map(|line| names.iter().cloned().zip(line.split(',').map(str::to_owned)).collect()).collect()
}

/// A map over two conditions has the growth rates that `predict` gives and, over the friction coefficient, the ends of windows
/// that `critical` gives; the axes may be exchanged.
#[test]
fn a_map_shows_what_the_load_does_to_a_window() {
    let folder = folder();
    let [edges, svg] = ["edges.csv", "map.svg"].map(|name| text(&folder.path().join(name)));
    let args = ["--points", "3x2", "--edges", &edges, "--svg", &svg, "--csv", "-", "-q"];
    let map = |x: &str, y: &str| run(["map", "rough-pad", "--x", x, "--y", y].into_iter().chain(args)).exits(0).stdout;
    let csv = map("mu=0:0.8", "load=500:2000");
    let rows = table(&csv);
    assert_eq!(rows.len(), 6);
    for row in &rows {
        let found = json([
            "predict",
            "rough-pad",
            "--mu",
            &row["friction_coefficient"],
            "--load",
            &row["normal_load_n"],
            "--json",
        ]);
        assert_eq!(number(&found, "max_growth_rate_per_s").to_string(), row["max_growth_rate_per_s"], "{row:?}");
        assert_eq!(
            (found["unstable_modes"].to_string(), "7"),
            (row["unstable_modes"].clone(), row["pairs_closed"].as_str())
        );
    }
    let of_loads: Vec<f64> = table(&std::fs::read_to_string(&edges).unwrap())
        .iter()
        .map(|row| {
            assert_eq!(row["instability"], "begins");
            let found = json(["critical", "rough-pad", "--load", &row["normal_load_n"], "--json"]);
            let mu: f64 = row["friction_coefficient"].parse().unwrap();
            assert!((mu - number(&found, "critical_friction")).abs() < 1e-9, "{row:?}");
            mu
        })
        .collect();
    assert_eq!(of_loads.len(), 2);
    let drawn = std::fs::read_to_string(&svg).unwrap();
    assert!(drawn.starts_with("<svg") && drawn.contains("normal load, N") && drawn.contains("instability begins"));
    // Exchanged axes, and one line further: the same values in another order.
    let exchanged =
        run(["map", "rough-pad", "--x", "load=500:2000", "--y", "mu=0:0.8", "--points", "2x3", "--csv", "-", "-q"]);
    let sorted = |csv: &str| {
        let mut lines: Vec<String> = csv.lines().map(str::to_owned).collect();
        lines.sort();
        lines
    };
    assert_eq!(sorted(&exchanged.exits(0).stdout), sorted(&csv));
    // Over load and speed, at a fixed friction coefficient: squeal begins and ends with the load.
    let args = ["--mu", "0.4", "--points", "5x2", "--edges", &edges, "--csv", "-", "-q"];
    run(["map", "rough-pad", "--x", "load=100:2000", "--y", "speed=5:20"].into_iter().chain(args)).exits(0);
    let found = table(&std::fs::read_to_string(&edges).unwrap());
    let kinds: Vec<&str> = found.iter().map(|row| row["instability"].as_str()).collect();
    assert_eq!(kinds, ["begins", "ends", "begins", "ends"], "{found:?}");
    for row in &found {
        let load: f64 = row["normal_load_n"].parse().unwrap();
        let unstable = |factor: f64| {
            let load = (factor * load).to_string();
            let found = json(["predict", "rough-pad", "--mu", "0.4", "--load", &load, "--json"]);
            number(&found, "unstable_modes") > 0.0
        };
        assert_eq!(
            (unstable(0.999), unstable(1.001)),
            if row["instability"] == "begins" { (false, true) } else { (true, false) }
        );
    }
    // Where the pad jams there is a fault with its reason.
    let rig = write(folder.path(), "jamming.toml", &jamming());
    let map = run([
        "map",
        &rig,
        "--x",
        "mu=2:2.5",
        "--y",
        "load=50:90",
        "--points",
        "2x2",
        "--speed",
        "-13",
        "-q",
        "--svg",
        &svg,
    ]);
    map.exits(0);
    assert!(std::fs::read_to_string(&svg).unwrap().contains("no prediction"));
    run(["map", "nine-dof", "--x", "mu=0:1", "--y", "mu=0:1"]).exits(1).complains("the same condition");
    run(["map", "nine-dof", "--x", "mu=0:1", "--y", "speed=1:20000"]).exits(1).complains("disc_speed_rad_s is 20000");
    run(["map", "nine-dof", "--x", "heat=0:1"]).exits(2).complains("expected mu, load, speed or temperature");
    run(["map", "nine-dof", "--points", "1x5"]).exits(2).complains("expected at least 2");
}

/// A sweep over the load has the modes that `predict` gives, the same numbers, and its window has the ends that a map over
/// load and speed finds by another search. Where the pad jams it leaves out the loads and names the reason.
#[test]
fn a_sweep_over_the_load_shows_its_window() {
    let folder = folder();
    let [csv, svg, edges] = ["sweep.csv", "sweep.svg", "edges.csv"].map(|name| text(&folder.path().join(name)));
    let swept = run(["sweep", "rough-pad", "--mu", "0.4", "--load", "100:2000:475", "--csv", &csv, "--svg", &svg]);
    swept.exits(0).complains("1 window of instability");
    let rows = table(&std::fs::read_to_string(&csv).unwrap());
    let mut loads: Vec<&str> = rows.iter().map(|row| row["normal_load_n"].as_str()).collect();
    loads.dedup();
    assert_eq!(loads, ["100", "575", "1050", "1525", "2000"]);
    for load in &loads {
        let found = json(["predict", "rough-pad", "--mu", "0.4", "--load", load, "--json"]);
        let of_load: Vec<_> = rows.iter().filter(|row| row["normal_load_n"] == *load).collect();
        let modes = found["modes"].as_array().unwrap();
        assert_eq!(of_load.len(), modes.len());
        for (row, mode) in of_load.iter().zip(modes) {
            assert_eq!(row["mode_id"], mode["id"].to_string());
            assert_eq!(row["frequency_hz"], number(mode, "frequency_hz").to_string());
            assert_eq!(row["growth_rate_per_s"], number(mode, "growth_rate_per_s").to_string());
        }
    }
    let drawn = std::fs::read_to_string(&svg).unwrap();
    assert!(drawn.contains("normal load, N") && drawn.contains("rough-pad, friction coefficient 0.4, 13 rad/s"));
    assert!(!drawn.contains(">friction coefficient<"));
    // Two rectangles, one in each panel, shade the window: their edges, in units of the drawing, are those of the map.
    let args = ["--mu", "0.4", "--points", "5x2", "--edges", &edges, "--csv", "-", "-q"];
    run(["map", "rough-pad", "--x", "load=100:2000", "--y", "speed=13:14"].into_iter().chain(args)).exits(0);
    let found = table(&std::fs::read_to_string(&edges).unwrap());
    let expected: Vec<f64> = found[..2].iter().map(|row| row["normal_load_n"].parse().unwrap()).collect();
    let attribute = |tag: &str, name: &str| -> Option<f64> {
        tag.split_once(&format!(" {name}=\""))?.1.split('"').next()?.parse().ok()
    };
    let shaded: Vec<(f64, f64)> = drawn
        .split('<')
        .filter(|tag| tag.starts_with("rect") && tag.contains("opacity=\"0.12\""))
        .map(|tag| {
            let (x, width) = (attribute(tag, "x").unwrap(), attribute(tag, "width").unwrap());
            (x, width)
        })
        .collect();
    assert_eq!((shaded.len(), shaded[0]), (2, shaded[1]));
    let share = (expected[1] - expected[0]) / 1900.0;
    let axes = drawn
        .split('<')
        .filter(|tag| tag.starts_with("line"))
        .filter_map(|tag| Some((attribute(tag, "x2")? - attribute(tag, "x1")?).abs()));
    let whole = axes.fold(0.0, f64::max);
    assert!((shaded[0].1 / whole - share).abs() < 2e-3, "{shaded:?} of {whole}, expected {share}");
    // Jamming.
    let rig = write(folder.path(), "jamming.toml", &jamming());
    let swept = run(["sweep", &rig, "--mu", "2.5", "--speed", "-13", "--load", "50:90:20"]).exits(0);
    let swept = swept.complains("no prediction at 3 values of the normal load, N, the first at 50: ");
    assert_eq!(swept.stdout.lines().count(), 1);
}

/// A sweep over the speed of a rig whose friction falls with speed: at low speed the steep slope makes modes grow, at high
/// speed none does. What is swept must be one condition.
#[test]
fn a_sweep_over_the_speed_follows_the_slope_of_friction() {
    let folder = folder();
    let falls = "[friction]\nstribeck_drop = 0.3\nstribeck_speed_m_s = 0.5\n";
    let rough = std::fs::read_to_string(crate::program::launch("rough-pad.toml")).unwrap();
    let falling =
        rough.replacen("[pad]", &format!("{falls}[pad]"), 1).replace("[[contact]]", "[[contact]]\nradius_m = 0.1");
    let rig = write(folder.path(), "falling.toml", &falling);
    let growth = |mu: &str, speeds: &str| -> Vec<(f64, f64)> {
        let rows = table(&run(["sweep", &rig, "--mu", mu, "--speed", speeds]).exits(0).stdout);
        let value = |row: &std::collections::BTreeMap<String, String>, key: &str| row[key].parse::<f64>().unwrap();
        let mut of_speeds: Vec<(f64, f64)> = vec![];
        for row in &rows {
            let (speed, growth) = (value(row, "disc_speed_rad_s"), value(row, "growth_rate_per_s"));
            match of_speeds.last_mut().filter(|(last, _)| *last == speed) {
                Some((_, most)) => *most = most.max(growth),
                None => of_speeds.push((speed, growth)),
            }
        }
        of_speeds
    };
    let found = growth("0.1", "1:41:10");
    assert_eq!(found.iter().map(|(speed, _)| *speed).collect::<Vec<_>>(), [1.0, 11.0, 21.0, 31.0, 41.0]);
    eprintln!("{found:?}");
    assert!(found[0].1 > 0.0 && found[4].1 < 0.0, "{found:?}");
    // Without friction either direction of rotation is the same, to the last bit.
    let both = growth("0", "-3:3:6");
    assert_eq!((both.len(), both[0].1), (2, both[1].1));
    run(["sweep", &rig, "--load", "50:90:20", "--speed", "1:3:1"]).exits(1).complains("2 ranges, expected one of");
    run(["sweep", &rig, "--mu", "0.3"]).exits(1).complains("--mu is one friction coefficient: expected a range");
    run(["sweep", &rig, "--load", "0:2e7:1e6"]).exits(1).complains("normal_load_n is 20000000");
    run(["sweep", &rig, "--load", "heavy"]).exits(2).complains("--load");
}
