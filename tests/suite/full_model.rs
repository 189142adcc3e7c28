//! Full models from files: the tribometer as read back, and the errors of invalid files.

use std::path::Path;

use crate::program::{self, run, text, tribometer, write};
use squealcast::full_model::FullModelFile;
use squealcast::physics::OperatingPoint;

#[test]
fn the_tribometer_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let full = FullModelFile::load(&path).unwrap_or_else(|error| panic!("{error}"));
    let n = full.model.dimension();
    assert!(n >= 5000);
    assert_eq!(full.pairs.len(), 294);
    assert_eq!(full.geometry.len(), 2);
    for pair in &full.pairs {
        // Coincident nodes: places in the tables of all nodes, not of the interface.
        let &[(disc_node, 1.0)] = pair.disc.as_slice() else { panic!("{pair:?}") };
        let (pad, disc) = (full.geometry[0].nodes_m[pair.pad_node], full.geometry[1].nodes_m[disc_node]);
        assert!((0..3).all(|axis| (pad[axis] - disc[axis]).abs() < 1e-12), "{pad:?} {disc:?}");
    }
    // A rigid motion of pad and disc together stretches no contact spring.
    let contact = full.model.contact.as_ref().unwrap();
    for row in contact.normal.iter().chain(&contact.sliding).chain(&contact.lateral) {
        assert!(row.iter().map(|(_, weight)| weight).sum::<f64>().abs() < 1e-12, "{row:?}");
        assert!((row.iter().map(|(_, weight)| weight * weight).sum::<f64>() - 2.0).abs() < 1e-12, "{row:?}");
    }
    // Without friction the whole is symmetric.
    let point = OperatingPoint { friction_coefficient: 0.0, ..full.settings.reference };
    let [mass, _, stiffness] = full.model.matrices_at(&point).unwrap();
    assert!(squealcast::reduction::is_symmetric(&mass) && squealcast::reduction::is_symmetric(&stiffness));
    run(["check", &text(&path)])
        .exits(0)
        .says("294 pairs")
        .says("294 of coincident nodes, 0 interpolated")
        .says("pad-nodes.csv, pad-rows.csv, pad-stiffness.mtx, pad-mass.mtx, disc-nodes.csv")
        .says(&full.content_hash);
    // Another digit in a matrix is another model.
    let mass = folder.path().join("pad-mass.mtx");
    let changed = std::fs::read_to_string(&mass).unwrap().replacen("% mass", "% Mass", 1);
    std::fs::write(&mass, changed).unwrap();
    assert_ne!(FullModelFile::load(&path).unwrap().content_hash, full.content_hash);
    // Both parts are read at the same time. Of two errors the pad's is reported, even if the disc's is found long before it.
    std::fs::remove_file(folder.path().join("disc-nodes.csv")).unwrap();
    run(["check", &text(&path)]).exits(1).complains("disc.nodes = \"disc-nodes.csv\" cannot be read");
    let cut = std::fs::read_to_string(&mass).unwrap();
    std::fs::write(&mass, cut.trim_end().rsplit_once('\n').unwrap().0).unwrap();
    run(["check", &text(&path)]).exits(1).complains("pad-mass.mtx").complains("entries end after");
}

/// A pad of one node that moves in x, y, z before a rigid disc.
fn one_node(folder: &Path) -> String {
    write(folder, "k.mtx", "%%MatrixMarket matrix coordinate real general\n3 3 3\n1 1 3e6\n2 2 4e6\n3 3 5e6\n");
    write(folder, "m.mtx", "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 1\n2 2 1\n3 3 2\n");
    write(folder, "nodes.csv", "node,x_m,y_m,z_m\n17,0.1,0,0\n");
    write(folder, "rows.csv", "node,direction\n17,x\n17,y\n17,z\n");
    let toml = "name = \"one\"\n[pad]\nstiffness = \"k.mtx\"\nmass = \"m.mtx\"\nnodes = \"nodes.csv\"\nrows = \"rows.csv\"\n\
                interface_nodes = [17]\n[[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 1.0, 0.0]\n\
                normal = [0.0, 1.0, 0.0]\nstiffness_n_per_m = 1e6\n";
    write(folder, "one.toml", toml)
}

#[test]
fn errors_name_file_line_and_value() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let toml = one_node(folder);
    run(["check", &toml]).exits(0).says("3 degrees of freedom").says("disc       rigid");
    let head = "%%MatrixMarket matrix coordinate real";
    for (file, content, expected) in [
        (
            "k.mtx",
            format!("{head} general\n3 3 4\n1 1 3\n2 2 4\n3 3 5\n3 1 0.5\n"),
            "k.mtx, line 6: entry at row 3, column 1 is 0.5, but 0 at row 1, column 3; expected a symmetric matrix",
        ),
        (
            "k.mtx",
            format!("{head} symmetric\n3 3 3\n1 1 3\n2 2 -4\n3 3 5\n"),
            "k.mtx, line 4: entry at row 2, column 2 is -4; expected at least 0",
        ),
        (
            "m.mtx",
            format!("{head} symmetric\n3 3 3\n1 1 3\n2 2 0\n3 3 5\n"),
            "m.mtx, line 4: entry at row 2, column 2 is 0; expected more than 0",
        ),
        ("k.mtx", format!("{head} symmetric\n3 3 3\n1 1 3\n2 2 4\n"), "k.mtx, line 4: entries end after 2; expected 3"),
        (
            "k.mtx",
            format!("{head} symmetric\n2 2 2\n1 1 3\n2 2 4\n"),
            "one.toml: `pad.stiffness` has shape 2x2 with 2 entries (k.mtx), expected 3x3, as rows.csv",
        ),
        (
            "nodes.csv",
            "node,x_m,y_m,z_m\n17,0.1,0,nan\n".to_owned(),
            "nodes.csv, line 2: z_m is `nan`; expected a finite number",
        ),
        (
            "nodes.csv",
            "node,x_m,y_m,z_m\n18,0.1,0,0\n".to_owned(),
            "rows.csv: `row 0` is at node 17, expected a node of nodes.csv",
        ),
        (
            "rows.csv",
            "node,direction\n17,x\n17,w\n17,z\n".to_owned(),
            "rows.csv, line 3: row is `17,w`; expected a node and one of x, y, z",
        ),
        ("rows.csv", "node,direction\n17,x\n17,x\n17,z\n".to_owned(), "rows.csv: `row 1` is node 17 again, as row 0"),
    ] {
        one_node(folder);
        write(folder, file, &content);
        run(["check", &toml]).exits(1).complains(expected);
    }
    one_node(folder);
    std::fs::remove_file(folder.join("m.mtx")).unwrap();
    run(["check", &toml]).exits(1).complains("one.toml: pad.mass = \"m.mtx\" cannot be read");
}

/// A pad of one node that jams, as the rig `jamming` of `contact_rigs`: `K_0 = [1.5 0.75; 0.75 0.5]` MN/m along -t and n, a
/// contact spring of 4/3 MN/m; with reversed sliding its matrix is singular at `μ = (0.1875 + 1.5 k) / (0.75 k) = 2.1875`.
#[test]
fn a_full_model_that_jams_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let toml = std::fs::read_to_string(one_node(folder)).unwrap();
    let matrix = "%%MatrixMarket matrix coordinate real symmetric\n3 3 4\n1 1 3e6\n2 2 5e5\n3 3 15e5\n3 2 75e4\n";
    write(folder, "k.mtx", matrix);
    let state = "[contact_state]\nlaw = \"linear\"\nmeasured = \"back-force\"\nload_nodes = [17]\n\
                 load_direction = [0.0, -1.0, 0.0]\n[limits]\nfriction_coefficient = [0.0, 3.0]\n";
    let toml = toml.replace("stiffness_n_per_m = 1e6", &format!("stiffness_n_per_m = {}", 4e6 / 3.0)) + state;
    let path = write(folder, "jamming.toml", &toml);
    run(["full", &path, "--mu", "2.1", "--speed", "-13"]).exits(0).says("contact: 1 of 1 pairs closed");
    run(["full", &path, "--mu", "2.2", "--speed", "-13"]).exits(1).complains("the pad jams at 2.187500");
    run(["check", &path]).exits(0).says("1 pairs that open and close; the load acts on 1 degrees of freedom");
}

/// The lines of a matrix of CalculiX: row, column, value.
fn listed(path: &Path) -> Vec<(usize, usize, String)> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines()
        .map(|line| {
            let words: Vec<&str> = line.split_whitespace().collect();
            (words[0].parse().unwrap(), words[1].parse().unwrap(), words[2].to_owned())
        })
        .collect()
}

/// The lowest modes of the disc of a full model.
fn modes(path: &str) -> Vec<f64> {
    let full = FullModelFile::load(Path::new(path)).unwrap_or_else(|error| panic!("{error}"));
    let disc = &full.model.parts[1];
    squealcast::reduction::lowest_modes("disc", &disc.mass, &disc.stiffness, 12).unwrap().omega_squared
}

/// The disc of the tribometer by CalculiX itself; the same matrices as Matrix Market and as Abaqus lists them.
#[test]
fn calculix_abaqus_and_matrix_market_give_the_same_modes() {
    let ccx = std::process::Command::new("ccx").arg("-v").output();
    if ccx.is_err() {
        return program::skipped("there is no ccx (Debian package calculix-ccx)");
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let path = tribometer(folder, 5000);
    let deck = std::fs::read_to_string(folder.join("disc.inp")).unwrap();
    assert!(deck.contains("*FREQUENCY\n"));
    write(folder, "stored.inp", &deck.replace("*FREQUENCY\n", "*FREQUENCY, SOLVER=MATRIXSTORAGE\n"));
    let ended = std::process::Command::new("ccx").arg("stored").current_dir(folder).output().unwrap();
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stdout));

    let toml: toml::Table = std::fs::read_to_string(&path).unwrap().parse().unwrap();
    let with_disc = |name: &str, files: [&str; 4], from: usize| {
        let mut toml = toml.clone();
        let disc = toml["disc"].as_table_mut().unwrap();
        for (key, file) in ["stiffness", "mass", "nodes", "rows"].into_iter().zip(files) {
            disc.insert(key.to_owned(), file.into());
        }
        if files[3].is_empty() {
            disc.remove("rows");
        }
        // Decks count nodes from 1.
        let interface = disc["interface_nodes"].as_array().unwrap().clone();
        let counted = interface.iter().map(|node| toml::Value::from(node.as_integer().unwrap() + from as i64));
        disc.insert("interface_nodes".to_owned(), counted.collect::<Vec<_>>().into());
        write(folder, name, &toml.to_string())
    };
    let calculix = with_disc("calculix.toml", ["stored.sti", "stored.mas", "disc.inp", "stored.dof"], 1);
    run(["check", &calculix]).exits(0).says("294 of coincident nodes");
    let expected = modes(&calculix);

    // Matrix Market lists the lower triangle, CalculiX the upper one.
    let dof = std::fs::read_to_string(folder.join("stored.dof")).unwrap();
    let labels: Vec<(u64, usize)> = dof
        .lines()
        .map(|line| line.trim().split_once('.').map(|(n, d)| (n.parse().unwrap(), d.parse().unwrap())).unwrap())
        .collect();
    let mut nodes = String::from("node,x_m,y_m,z_m\n");
    let mut known = 0;
    for (index, line) in std::fs::read_to_string(folder.join("disc-nodes.csv")).unwrap().lines().skip(1).enumerate() {
        nodes += &format!("{},{line}\n", index + 1);
        known = index + 1;
    }
    // Nodes of the elements' inner modes, anywhere.
    let inner: std::collections::BTreeSet<u64> = labels.iter().map(|(n, _)| *n).filter(|n| *n > known as u64).collect();
    assert!(!inner.is_empty(), "CalculiX has nodes of its own for incompatible modes");
    inner.iter().for_each(|node| nodes += &format!("{node},0,0,0\n"));
    write(folder, "labelled.csv", &nodes);
    let mut rows = String::from("node,direction\n");
    labels.iter().for_each(|(node, d)| rows += &format!("{node},{}\n", ["x", "y", "z"][d - 1]));
    write(folder, "rows.csv", &rows);
    for (what, file) in [("sti", "k"), ("mas", "m")] {
        let entries = listed(&folder.join(format!("stored.{what}")));
        let mut market =
            format!("%%MatrixMarket matrix coordinate real symmetric\n{0} {0} {1}\n", labels.len(), entries.len());
        let (mut labelled, mut numbered) = (String::from("** from CalculiX\n*MATRIX, TYPE=SYMMETRIC\n"), String::new());
        for (row, column, value) in &entries {
            let (low, high) = (row.min(column), row.max(column));
            market += &format!("{high} {low} {value}\n");
            let ((n, d), (m, e)) = (labels[row - 1], labels[column - 1]);
            labelled += &format!("{n},{d}, {m},{e}, {value}\n");
            numbered += &format!("{row:10} {column:10} {}\n", value.replace(['e', 'E'], "D"));
            if row != column {
                numbered += &format!("{column:10} {row:10} {}\n", value.replace(['e', 'E'], "D"));
            }
        }
        // A boundary condition as Abaqus writes it.
        labelled += &format!("{known},1, {known},1, {}\n", if file == "k" { "1.0e36" } else { "0.0" });
        let held = !labels.contains(&(known as u64, 1));
        if !held {
            labelled = labelled.lines().filter(|line| !line.ends_with("1.0e36")).map(|l| format!("{l}\n")).collect();
        }
        write(folder, &format!("{file}.mtx"), &market);
        write(folder, &format!("{file}-labels.txt"), &labelled);
        write(folder, &format!("{file}-numbers.txt"), &numbered);
    }
    for (name, files) in [
        ("market.toml", ["k.mtx", "m.mtx", "labelled.csv", "rows.csv"]),
        ("labels.toml", ["k-labels.txt", "m-labels.txt", "labelled.csv", ""]),
        ("numbers.toml", ["k-numbers.txt", "m-numbers.txt", "labelled.csv", "rows.csv"]),
    ] {
        for (found, expected) in modes(&with_disc(name, files, 1)).iter().zip(&expected) {
            // The same numbers in another order: rounding of the largest ω² of a mesh, 1e4 times these, in the factor.
            assert!((found / expected - 1.0).abs() < 1e-10, "{name}: {found} {expected}");
        }
    }
    // Our own bricks are others: their incompatible modes have mass. Both are of second order in the mesh, so that they
    // differ by no more than what the mesh itself leaves, which a finer one shows.
    let (ours, finer) = (modes(&text(&path)), modes(&text(&tribometer(&folder.join("finer"), 20_000))));
    for ((ours, theirs), finer) in ours.iter().zip(&expected).zip(&finer) {
        let (off, of_mesh) = ((ours / theirs - 1.0).abs(), (ours / finer - 1.0).abs());
        assert!(off < of_mesh, "{ours} and {theirs} rad^2/s^2 differ by {off:.1e}, on the finer mesh {finer}");
    }
    // Truncated, out of range, no number.
    for (file, content, expected) in [
        ("stored.sti", "1 1 2.0\n2 2\n", "stored.sti, line 2: entry is `2 2`"),
        ("stored.sti", "1 1 2.0\n99999999 2 1.0\n", "stored.sti, line 2: row is `99999999`"),
        ("stored.mas", "1 1 2.0\n1 2 x\n", "stored.mas, line 2: value is `x`"),
        ("stored.dof", "1.1\n1.9\n", "stored.dof, line 2: row is `1.9`"),
    ] {
        let before = std::fs::read(folder.join(file)).unwrap();
        write(folder, file, content);
        run(["check", &calculix]).exits(1).complains(expected);
        std::fs::write(folder.join(file), before).unwrap();
    }
}

/// Labelled rows as Abaqus lists them, a node held along z; a truncated file must not be taken for a smaller model.
#[test]
fn labelled_matrices_cut_short_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let toml = one_node(folder);
    let labelled = std::fs::read_to_string(&toml).unwrap();
    let labelled = labelled.replace("k.mtx", "k.txt").replace("m.mtx", "m.txt").replace("rows = \"rows.csv\"\n", "");
    let toml = write(folder, "labelled.toml", &labelled);
    let stiffness = "17,1, 17,1, 3e6\n17,1, 17,2, -1e6\n17,2, 17,2, 4e6\n17,3, 17,3, 1e36\n";
    let mass = "17,1, 17,1, 1\n17,2, 17,2, 1\n17,3, 17,3, 2\n";
    let check = |stiffness: &str, mass: &str| {
        write(folder, "k.txt", stiffness);
        write(folder, "m.txt", mass);
        run(["check", &toml])
    };
    check(stiffness, mass).exits(0).says("2 degrees of freedom");
    let lines = |text: &str, count: usize| text.lines().take(count).map(|line| format!("{line}\n")).collect::<String>();
    // What held node 17 along z is gone, so nothing says why it has mass but no row.
    check(&lines(stiffness, 3), mass).exits(1).complains(
        "m.txt, line 3: entry is at node 17, direction 3; expected a row of k.txt, or one that the stiffness constrains",
    );
    // Along y an entry off the diagonal is left: a row without a diagonal.
    check(&lines(stiffness, 2), mass)
        .exits(1)
        .complains("k.txt, line 2: entry at row 2, column 2 is missing up to here; expected every row on the diagonal");
    check(&lines(stiffness, 1), mass).exits(1).complains("m.txt, line 2: entry is at node 17, direction 2");
    check(stiffness, &lines(mass, 1))
        .exits(1)
        .complains("m.txt, line 1: entry at row 2, column 2 is missing up to here");
    check(stiffness, "17,1, 17,1, 1\n17,2, 17").exits(1).complains("m.txt, line 2: entry is `17,2, 17`");
    check(&stiffness.replace("4e6", "-4e6"), mass).exits(1).complains("k.txt, line 3: entry at row 2, column 2 is -4");
    // By rows that are listed, a label beyond them is no row either.
    let listed = labelled.replace("nodes = \"nodes.csv\"\n", "nodes = \"nodes.csv\"\nrows = \"rows.csv\"\n");
    let listed = write(folder, "listed.toml", &listed);
    write(folder, "rows.csv", "node,direction\n17,x\n");
    run(["check", &listed])
        .exits(1)
        .complains("k.txt, line 2: entry is at node 17, direction 2; expected a row of rows.csv");
}

/// An error of a matrix that only the factorisation finds names its file.
#[test]
fn indefinite_matrices_are_refused_by_file_name() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let toml = one_node(folder);
    let head = "%%MatrixMarket matrix coordinate real symmetric\n3 3 4\n";
    let to = text(&folder.join("rig.toml"));
    let reduce = || run(["reduce", &toml, "--modes", "3", "--no-residual", "--points", "0", "-o", &to]);
    write(folder, "m.mtx", &format!("{head}1 1 1\n2 1 2\n2 2 1\n3 3 2\n"));
    reduce().exits(1).complains("one.toml (m.mtx): pad.mass is not positive definite: its pivot at row 1 is -3");
    one_node(folder);
    write(folder, "k.mtx", &format!("{head}1 1 3e6\n2 1 5e6\n2 2 4e6\n3 3 5e6\n"));
    reduce().exits(1).complains("one.toml (k.mtx)").complains("pad.stiffness");
}

/// Natural frequencies that CalculiX lists, Hz.
fn calculix_hz(dat: &Path) -> Vec<f64> {
    let text = std::fs::read_to_string(dat).unwrap();
    let table = text.split("P A R T I C I P A T I O N").next().unwrap();
    // Number, eigenvalue, real part in rad/s and in Hz, imaginary part.
    let row = |line: &str| {
        let words: Vec<f64> = line.split_whitespace().map(str::parse).collect::<Result<_, _>>().ok()?;
        (words.len() == 5).then(|| words[3])
    };
    table.lines().filter_map(row).collect()
}

/// Both parts at 100 000 degrees of freedom and more against C3D8I on the same mesh: first 20 frequencies within 0.1 %.
/// Minutes of CalculiX; only where figures are measured.
#[test]
fn at_size_the_first_20_frequencies_are_those_of_calculix() {
    if !program::measuring() {
        program::aloud("skipped: it takes half an hour; SQUEALCAST_MEASURE=1 runs it");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let path = tribometer(folder, 240_000);
    let full = FullModelFile::load(&path).unwrap();
    for part in &full.model.parts {
        let name = &part.name;
        let started = std::time::Instant::now();
        let ours = squealcast::reduction::lowest_modes(name, &part.mass, &part.stiffness, 20).unwrap();
        let took = started.elapsed().as_secs_f64();
        let started = std::time::Instant::now();
        let ended = std::process::Command::new("ccx").arg(name).current_dir(folder).output().expect("ccx");
        assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stdout));
        let theirs_took = started.elapsed().as_secs_f64();
        let theirs = calculix_hz(&folder.join(format!("{name}.dat")));
        assert!(part.mass.nrows() > 100_000 && theirs.len() == 20, "{name}: {theirs:?}");
        let hz = ours.omega_squared.iter().map(|square| square.sqrt() / std::f64::consts::TAU);
        let worst = hz.zip(&theirs).map(|(ours, theirs)| (ours / theirs - 1.0).abs()).fold(0.0, f64::max);
        let n = part.mass.nrows();
        eprintln!("{name}: {n} degrees of freedom, {worst:.2e} off; {took:.0} s, CalculiX {theirs_took:.0} s");
        assert!(worst < 1e-3, "{name}: {worst:e}");
    }
}

/// The full tribometer at 5000 degrees of freedom: the roots of `full` are those that a dense solve of the model on its
/// own lowest modes comes near to from above, with residuals at rounding; turning the other way is the negative friction.
#[test]
fn the_full_tribometer_is_solved() {
    let folder = tempfile::tempdir().unwrap();
    let path = text(&tribometer(folder.path(), 5000));
    let with_limits = std::fs::read_to_string(&path).unwrap() + "\n[limits]\nfriction_coefficient = [-1.0, 1.0]\n";
    std::fs::write(&path, with_limits).unwrap();
    let started = std::time::Instant::now();
    let at_rest = program::json(["full", &path, "--mu", "0", "--band-hz", "5000", "--json"]);
    eprintln!("solved in {:.1} s", started.elapsed().as_secs_f64());
    let roots = |value: &serde_json::Value| -> Vec<(f64, f64)> {
        let roots = value["roots"].as_array().unwrap();
        assert!(roots.iter().all(|root| program::number(root, "residual") < 1e-12));
        let both = |root| (program::number(root, "growth_rate_per_s"), program::number(root, "omega_rad_s"));
        roots.iter().map(both).collect()
    };
    // Without friction the whole is symmetric: its modes by Lanczos, counted by their inertia.
    let full = FullModelFile::load(Path::new(&path)).unwrap();
    let point = OperatingPoint { friction_coefficient: 0.0, ..full.settings.reference };
    let [mass, _, stiffness] = full.model.matrices_at(&point).unwrap();
    let found = roots(&at_rest);
    let band = 2.0 * std::f64::consts::PI * 5000.0;
    let wanted = squealcast::reduction::Wanted::Below(band);
    let modes = squealcast::reduction::normal_modes("whole", &mass, &stiffness, wanted, None, &mut |_| {}).unwrap();
    assert_eq!(found.len(), modes.omega_squared.len());
    for ((growth, omega), square) in found.iter().zip(&modes.omega_squared) {
        // Both are good to rounding of the stiffest row, 1e-16 of an ω² of 1e13, near an ω² of 1e7.
        assert!(
            (omega * omega / square - 1.0).abs() < 1e-9 && growth.abs() < 1e-6 * omega,
            "{growth} {omega} {square}"
        );
    }
    let forward = roots(&program::json(["full", &path, "--mu", "0.4", "--band-hz", "5000", "--json"]));
    let backward =
        roots(&program::json(["full", &path, "--mu", "-0.4", "--speed", "-13", "--band-hz", "5000", "--json"]));
    assert_eq!(forward.len(), backward.len());
    assert!(forward.len() == found.len(), "{} roots with friction, {} without", forward.len(), found.len());
    for (a, b) in forward.iter().zip(&backward) {
        assert!((a.1 - b.1).abs() < 1e-9 * a.1 + 1e-9 && (a.0.abs() - b.0.abs()).abs() < 1e-7 * a.1, "{a:?} {b:?}");
    }
    run(["full", &path, "--memory-gib", "0.01"]).exits(1).complains("more than the 0.01 GiB allowed");
    run(["full", &path, "--mu", "0.4"]).exits(0).says("covered: 0 to 4000 Hz");
}

/// A rig of kind 3 without truncation is its own full model: no error beyond rounding, nothing missed or invented.
#[test]
fn a_rig_that_leaves_nothing_out_agrees() {
    let rig = program::launch("hulten.toml");
    let found = program::json(["verify", &rig, "--against", &rig, "--points", "5", "--json"]);
    let certificate = &found["certificate"];
    assert!(program::number(certificate, "max_relative_error") < 1e-10, "{certificate}");
    assert_eq!((&certificate["missed"], &certificate["invented"]), (&0.into(), &0.into()));
    assert!(!found["windows"].as_array().unwrap().is_empty(), "{found}");
    assert!(program::number(certificate, "critical_friction_error") < 1e-9, "{certificate}");
    // What verify found, carried by a rig file, is shown.
    let folder = tempfile::tempdir().unwrap();
    for file in ["hulten-mass.mtx", "hulten-stiffness.mtx", "hulten-friction.mtx"] {
        std::fs::copy(program::launch(file), folder.path().join(file)).unwrap();
    }
    let table: toml::Table = serde_json::from_value(certificate.clone()).unwrap();
    let mut carried: toml::Table = std::fs::read_to_string(&rig).unwrap().parse().unwrap();
    carried.insert("reduction".to_owned(), table.into());
    let carried = write(folder.path(), "carried.toml", &carried.to_string());
    run(["check", &carried])
        .exits(0)
        .says("errors at 5 held-out points")
        .says("0 unstable modes or windows missed, 0 invented");
}

/// Where memory is too little for a factor in double precision, roots are those of double precision in every printed digit, and
/// progress says how the factor is kept.
#[test]
fn little_memory_is_enough_for_factors_in_single_precision() {
    let folder = tempfile::tempdir().unwrap();
    let path = text(&tribometer(folder.path(), 80_000));
    let args = ["full", path.as_str(), "--mu", "0.4", "--band-hz", "3000"];
    let double = run(args.into_iter().chain(["--memory-gib", "8"])).exits(0);
    assert!(!double.stderr.contains("single precision"), "{}", double.stderr);
    // "[    0.9 s    0.22 GiB] full model: ordered and analysed, needs 0.50 GiB at least"
    let analysed = double.stderr.lines().find(|line| line.contains("ordered and analysed, needs")).unwrap();
    let gib: Vec<f64> = analysed
        .split(" GiB")
        .filter_map(|before| before.rsplit_once(' ').and_then(|(_, number)| number.parse().ok()))
        .collect();
    let [resident, needed] = gib[..] else { panic!("{analysed}") };
    // The factors have 32 million numbers, of which single precision saves half of 0.24 GiB.
    let limit = format!("{:.3}", resident + needed - 0.06);
    let single = run(args.into_iter().chain(["--memory-gib", &limit])).exits(0);
    assert!(single.stderr.contains("kept in single precision to save memory"), "{}", single.stderr);
    // Without the column of residuals.
    let roots = |stdout: &str| -> Vec<Vec<String>> {
        let rows = stdout.lines().filter(|line| line.starts_with("  ") && line.contains("e-"));
        rows.map(|row| row.split_whitespace().take(3).map(str::to_owned).collect()).collect()
    };
    assert!(roots(&single.stdout).len() > 10);
    assert_eq!(roots(&single.stdout), roots(&double.stdout));
}
