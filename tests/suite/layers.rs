//! Imports point inward: a room may use those listed before it, never one listed after. ARCHITECTURE.md says what is in
//! the rooms. Code in `#[cfg(test)]` modules is exempt.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use squealcast::physics::chart::BUILDER;

/// Rooms of `crates/core/src`, from the inside out.
const CORE: &[&str] = &["chebyshev", "product", "sampling", "spoil", "contact", "physics", "reduction", "fem", "proof"];

/// Rooms of `src`, from the inside out, after the libraries that `src/lib.rs` passes on.
const PROGRAM: &[&str] = &[
    "contact",
    "physics",
    "reduction",
    "fem",
    "proof",
    "msgs",
    "text",
    "system",
    "files",
    "random",
    "sound",
    "rig",
    "full_model",
    "export",
    "session",
    "analysis",
    "simulator",
    "recording",
    "bus",
    "foxglove",
    "import",
    "node",
    "offline",
    "figures",
    "display",
    "evidence",
    "study",
    "commands",
];

/// Imports that point outward, and why they are there: file, room, reason.
const OUTWARD: &[(&str, &str, &str)] = &[
    ("figures/plot.rs", "display", "figures are drawn from the curves and the history that the page shows"),
    (
        "figures/plot.rs",
        "evidence",
        "the figure of run time against error is drawn from the routes that `bench` measured",
    ),
];

/// Files of the core that import each other in a circle, and why.
const CIRCLES: &[(&[&str], &str)] = &[
    (
        &[
            "physics::decoupled",
            "physics::dense_eigen",
            "physics::flexible_contact",
            "physics::model",
            "physics::solver",
            "physics::spectrum",
            "physics::steady_contact",
        ],
        "a model holds its division into coupled and uncoupled coordinates, which is a model and completes a spectrum, and \
         its steady contact, which makes a model for every state; a failed solve carries the error of the model",
    ),
    (
        &["physics::critical", "physics::ends", "physics::numbering", "physics::stability_map", "physics::summary"],
        "a map holds its windows and its numbering of modes, both made from its nodes",
    ),
    (&["contact::law", "contact::spline"], "a law may be a table, and a table gives the values of a law"),
    (
        &["contact::anchors", "contact::equations", "contact::newton", "contact::path", "contact::statics"],
        "statics are solved along a path or from anchors, whose states are states of the statics",
    ),
    (
        &["physics::chart::build", "physics::chart::leaf"],
        "a build makes leaves, and a leaf reads the options of its build",
    ),
];

/// Modules of the core that the builder of charts imports and that do not determine the result of a build, and why.
const BESIDE_BUILDER: &[(&str, &str)] =
    &[("physics::numbering", "numbers the roots of a chart that is evaluated; charts hold no identities")];

/// A Rust file: its path below the root, and its text without comments and without what follows `#[cfg(test)] mod`.
struct Source {
    path: String,
    text: String,
}

fn sources(root: &Path) -> Vec<Source> {
    let (mut folders, mut found) = (vec![root.to_owned()], vec![]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap().map(Result::unwrap) {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = without_tests(&fs::read_to_string(&path).unwrap());
                let path = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
                found.push(Source { path, text });
            }
        }
    }
    let tests: BTreeSet<String> = found.iter().flat_map(test_files).collect();
    found.retain(|source| !tests.contains(&source.path));
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// Comments become empty, so that lines keep their numbers; the text ends before the first module of tests.
fn without_tests(text: &str) -> String {
    let lines: Vec<&str> =
        text.lines().map(|line| if line.trim_start().starts_with("//") { "" } else { line }).collect();
    let is_tests = |pair: &[&str]| pair[0] == "#[cfg(test)]" && pair[1].contains("mod ") && pair[1].ends_with('{');
    let end = lines.windows(2).position(is_tests).unwrap_or(lines.len());
    lines[..end].join("\n")
}

/// Files that `#[cfg(test)] mod NAME;` declares.
fn test_files(source: &Source) -> Vec<String> {
    let folder = match source.path.rsplit_once('/') {
        _ if source.path == "lib.rs" => String::new(),
        Some((folder, "mod.rs")) => format!("{folder}/"),
        _ => format!("{}/", source.path.trim_end_matches(".rs")),
    };
    let lines: Vec<&str> = source.text.lines().collect();
    let declared = lines.windows(2).filter(|pair| pair[0] == "#[cfg(test)]" && pair[1].ends_with(';'));
    let name = |pair: &[&str]| pair[1].trim_end_matches(';').split("mod ").last().unwrap().to_owned();
    declared.map(|pair| format!("{folder}{}.rs", name(pair))).collect()
}

/// The room of a file: its folder, or its own name.
fn room(path: &str) -> &str {
    path.split('/').next().unwrap().trim_end_matches(".rs")
}

/// Every `crate::ROOM` in a text, with its line.
fn mentions(text: &str) -> Vec<(usize, String)> {
    let mut found = vec![];
    for (index, line) in text.lines().enumerate() {
        for (at, path) in line.match_indices("crate::") {
            // `$crate` in macros counts, `squealcast_crate::` would not.
            let rest = &line[at + path.len()..];
            let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
            found.push((index + 1, name));
        }
    }
    found
}

/// Imports of rooms listed later, as `FILE:LINE: ...`; `rooms` also decides which files count.
fn outward(sources: &[Source], rooms: &[&str]) -> Vec<(String, String, String)> {
    let rank = |room: &str| rooms.iter().position(|name| *name == room);
    let mut found = vec![];
    for source in sources.iter().filter(|source| !["lib.rs", "main.rs"].contains(&source.path.as_str())) {
        let own = room(&source.path);
        let Some(own_rank) = rank(own) else {
            panic!("{}: the room {own} is not in the list of rooms of tests/suite/layers.rs", source.path);
        };
        for (line, used) in mentions(&source.text) {
            if rank(&used).is_some_and(|rank| rank > own_rank) {
                let told = format!("{}:{line}: {own} uses {used}, which is further out", source.path);
                found.push((source.path.clone(), used, told));
            }
        }
    }
    found
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn no_import_of_the_program_points_outward() {
    let found = outward(&sources(&root().join("src")), PROGRAM);
    let excepted = |file: &str, used: &str| OUTWARD.iter().any(|(f, room, _)| *f == file && *room == used);
    let wrong: Vec<&str> =
        found.iter().filter(|(file, used, _)| !excepted(file, used)).map(|(_, _, told)| told.as_str()).collect();
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    for (file, used, _) in OUTWARD {
        let still = found.iter().any(|(f, room, _)| f == file && room == used);
        assert!(still, "{file} no longer uses {used}: take it off the list of exceptions");
    }
}

#[test]
fn no_import_of_the_core_points_outward() {
    let found = outward(&sources(&root().join("crates/core/src")), CORE);
    let told: Vec<&str> = found.iter().map(|(_, _, told)| told.as_str()).collect();
    assert!(told.is_empty(), "{}", told.join("\n"));
}

/// Rooms of the program that the Python package uses: what computes, reads recordings, draws and speaks shared memory.
const OF_PYTHON: &[&str] = &[
    "analysis",
    "bus",
    "commands",
    "display",
    "figures",
    "files",
    "msgs",
    "node",
    "physics",
    "recording",
    "rig",
    "session",
];

/// The package is a layer on the library, which knows nothing of Python.
#[test]
fn the_python_package_uses_the_library_and_not_the_other_way_round() {
    let mut used = BTreeSet::new();
    for source in sources(&root().join("crates/python/src")) {
        let paths = source.text.split("squealcast::").skip(1);
        let name = |rest: &str| rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
        used.extend(paths.map(name).filter(|name| !name.is_empty()));
    }
    assert_eq!(used, OF_PYTHON.iter().map(|room| (*room).to_owned()).collect(), "rooms that crates/python uses");
    for folder in ["src", "crates/core/src", "msgs/src"] {
        let python: Vec<String> = sources(&root().join(folder))
            .into_iter()
            .filter(|source| source.text.contains("pyo3") || source.text.contains("numpy::"))
            .map(|source| source.path)
            .collect();
        assert!(python.is_empty(), "{folder} knows Python: {python:?}");
    }
    for manifest in ["Cargo.toml", "crates/core/Cargo.toml", "msgs/Cargo.toml"] {
        assert!(!fs::read_to_string(root().join(manifest)).unwrap().contains("pyo3"), "{manifest}");
    }
}

/// The path of each import of a text as a list of names: `use a::{b, c::d};` gives `a::b` and `a::c::d`.
fn imports(text: &str) -> Vec<Vec<String>> {
    let statements = text.split(';').filter_map(|statement| {
        let start = statement.lines().position(|line| {
            let line = line.trim_start();
            line.starts_with("use ") || (line.starts_with("pub") && line.contains(" use "))
        })?;
        let statement: String = statement.lines().skip(start).collect();
        Some(statement.split_once("use ")?.1.split_whitespace().collect::<String>())
    });
    statements.flat_map(|tree| leaves(&tree)).collect()
}

/// The paths of a tree of imports without white space.
fn leaves(tree: &str) -> Vec<Vec<String>> {
    let Some((before, inside)) = tree.split_once('{') else {
        return vec![tree.split("::").map(str::to_owned).collect()];
    };
    let inside = inside.strip_suffix('}').unwrap_or(inside);
    let (mut depth, mut parts) = (0, vec![String::new()]);
    for c in inside.chars() {
        match c {
            ',' if depth == 0 => parts.push(String::new()),
            _ => {
                depth += i32::from(c == '{') - i32::from(c == '}');
                parts.last_mut().unwrap().push(c);
            }
        }
    }
    parts.iter().filter(|part| !part.is_empty()).flat_map(|part| leaves(&format!("{before}{part}"))).collect()
}

/// Which modules of the core each module imports. What a module imports from its own children does not count.
fn module_graph(sources: &[Source]) -> BTreeMap<String, BTreeSet<String>> {
    let module = |path: &str| path.trim_end_matches(".rs").trim_end_matches("/mod").replace('/', "::");
    let modules: BTreeSet<String> = sources.iter().map(|source| module(&source.path)).collect();
    let mut graph = BTreeMap::new();
    for source in sources.iter().filter(|source| source.path != "lib.rs") {
        let own = module(&source.path);
        let parent: Vec<&str> = own.rsplit_once("::").map_or(vec![], |(parent, _)| parent.split("::").collect());
        let mut used = BTreeSet::new();
        for path in imports(&source.text) {
            let mut full: Vec<&str> = match path[0].as_str() {
                "crate" => vec![],
                "super" => parent.clone(),
                _ => continue,
            };
            full.extend(path[1..].iter().map(String::as_str));
            while !full.is_empty() && !modules.contains(&full.join("::")) {
                full.pop();
            }
            if !full.is_empty() && full.join("::") != own {
                used.insert(full.join("::"));
            }
        }
        graph.insert(own, used);
    }
    graph
}

/// Sets of modules that reach each other.
fn circles(graph: &BTreeMap<String, BTreeSet<String>>) -> BTreeSet<Vec<String>> {
    let reach = |from: &String| {
        let (mut reached, mut next) = (BTreeSet::new(), vec![from.clone()]);
        while let Some(module) = next.pop() {
            for used in graph.get(&module).into_iter().flatten() {
                if reached.insert(used.clone()) {
                    next.push(used.clone());
                }
            }
        }
        reached
    };
    let reached: BTreeMap<&String, BTreeSet<String>> = graph.keys().map(|module| (module, reach(module))).collect();
    let circle = |module: &String| -> Vec<String> {
        let both = |other: &&String| reached[module].contains(*other) && reached[*other].contains(module);
        graph.keys().filter(both).cloned().collect()
    };
    graph.keys().map(circle).filter(|circle| circle.len() > 1).collect()
}

#[test]
fn files_of_the_core_import_each_other_in_the_known_circles_only() {
    let found = circles(&module_graph(&sources(&root().join("crates/core/src"))));
    let known: BTreeSet<Vec<String>> =
        CIRCLES.iter().map(|(circle, _)| circle.iter().map(|module| (*module).to_owned()).collect()).collect();
    assert_eq!(found, known, "circles found, and those listed in tests/suite/layers.rs");
}

/// A stored chart is keyed by the sources in `BUILDER`: if one were missing, a changed builder would use old charts.
#[test]
fn charts_are_keyed_by_all_sources_that_their_builder_imports() {
    let sources = sources(&root().join("crates/core/src"));
    let graph = module_graph(&sources);
    let (mut reached, mut next) = (BTreeSet::new(), vec!["physics::chart::build"]);
    while let Some(module) = next.pop() {
        if BESIDE_BUILDER.iter().all(|(name, _)| *name != module) && reached.insert(module) {
            next.extend(graph[module].iter().map(String::as_str));
            // A module may pass on what its children define.
            let child = |name: &&String| name.strip_prefix(module).is_some_and(|rest| rest.starts_with("::"));
            next.extend(graph.keys().filter(child).map(String::as_str));
        }
    }
    let file = |module: &str| {
        let path = root().join("crates/core/src").join(module.replace("::", "/"));
        fs::read_to_string(path.with_extension("rs")).or_else(|_| fs::read_to_string(path.join("mod.rs"))).unwrap()
    };
    let missing: Vec<&&str> = reached.iter().filter(|module| !BUILDER.contains(&file(module).as_str())).collect();
    assert!(missing.is_empty(), "not in BUILDER of physics/chart/words.rs: {missing:?}");
    for (module, _) in BESIDE_BUILDER {
        let used = reached.iter().any(|user| graph[*user].contains(*module));
        assert!(used, "the builder no longer imports {module}: take it off the list");
    }
}

#[test]
fn an_outward_import_and_a_circle_are_found() {
    let source = |path: &str, text: &str| Source { path: path.to_owned(), text: without_tests(text) };
    let files = [
        source("a.rs", "//! crate::b in a comment\nuse std::fmt;\nuse crate::b::{c, d::{E,\n    F}};\n"),
        source("b/mod.rs", "mod c;\n#[cfg(test)]\nmod tests {\n    use crate::a::X;\n}\n"),
        source("b/c.rs", "use super::d::E;\n"),
        source("b/d.rs", "pub use super::c::F;\n"),
    ];
    let told: Vec<String> = outward(&files, &["a", "b"]).into_iter().map(|(_, _, told)| told).collect();
    assert_eq!(told, ["a.rs:3: a uses b, which is further out"]);
    let graph = module_graph(&files);
    assert_eq!(graph["a"], BTreeSet::from(["b::c".to_owned(), "b::d".to_owned()]));
    assert_eq!(circles(&graph), BTreeSet::from([vec!["b::c".to_owned(), "b::d".to_owned()]]));
}
