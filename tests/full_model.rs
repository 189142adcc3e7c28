//! Full models from files: what is read of the tribometer, and what is said of files that are wrong.
#![cfg(feature = "node")]

mod program;

use std::path::Path;

use program::{run, text, write};
use squealcast::full_model::FullModelFile;
use squealcast::physics::OperatingPoint;

#[test]
fn the_tribometer_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    run(["tribometer", "--dof", "5000", "-o", &text(folder.path())]).exits(0);
    let path = folder.path().join("tribometer.toml");
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
        .says(&full.content_hash);
    // Another digit in a matrix is another model.
    let mass = folder.path().join("pad-mass.mtx");
    let changed = std::fs::read_to_string(&mass).unwrap().replacen("% mass", "% Mass", 1);
    std::fs::write(&mass, changed).unwrap();
    assert_ne!(FullModelFile::load(&path).unwrap().content_hash, full.content_hash);
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
fn what_is_wrong_is_told_with_file_line_and_value() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let toml = one_node(folder);
    run(["check", &toml]).exits(0).says("3 degrees of freedom").says("disc       rigid");
    let head = "%%MatrixMarket matrix coordinate real";
    for (file, content, told) in [
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
        run(["check", &toml]).exits(1).complains(told);
    }
    one_node(folder);
    std::fs::remove_file(folder.join("m.mtx")).unwrap();
    run(["check", &toml]).exits(1).complains("one.toml: pad.mass = \"m.mtx\" cannot be read");
}
