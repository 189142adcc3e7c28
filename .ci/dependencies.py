"""Checks every crate that the workspace depends on, as `cargo metadata` describes it:

- its licence is one that deny.toml allows;
- it comes from the crate registry;
- it asks for no newer Rust than `rust-version` of Cargo.toml.

Lists crates of which several versions are compiled. Advisories are left to `cargo deny check advisories`, which needs a
database from the network.
"""

import json
import re
import subprocess
import sys
import tomllib
from collections import defaultdict


def version(text):
    numbers = [int(number) for number in text.split(".")]
    return numbers + [0] * (3 - len(numbers))


def printed(*command):
    return subprocess.run(["cargo", *command, "--locked"], check=True, stdout=subprocess.PIPE, text=True).stdout


def is_allowed(expression, allowed):
    """Whether an SPDX expression, or the older form with slashes, can be met by allowed licences."""
    tokens = re.findall(r"\(|\)|[^\s()/]+(?:\s+WITH\s+[^\s()]+)?|/", expression)
    python = []
    for token in tokens:
        word = {"AND": "and", "OR": "or", "/": "or", "(": "(", ")": ")"}.get(token)
        python.append(word or str(re.sub(r"\s+", " ", token) in allowed))
    return eval(" ".join(python), {"__builtins__": {}})


with open("deny.toml", "rb") as file:
    licenses = tomllib.load(file)["licenses"]
    allowed = set(licenses["allow"])
    exceptions = {entry["crate"]: set(entry["allow"]) for entry in licenses["exceptions"]}
with open("Cargo.toml", "rb") as file:
    rust = tomllib.load(file)["workspace"]["package"]["rust-version"]
metadata = json.loads(printed("metadata", "--all-features", "--format-version", "1"))
# `cargo metadata` also lists optional crates that no feature selects; `cargo tree` does not.
compiled = set(printed("tree", "--workspace", "--all-features", "--edges", "all", "--prefix", "none", "--format", "{p}").splitlines())
compiled = {tuple(line.replace(" v", " ", 1).split()[:2]) for line in compiled if line}
packages = [package for package in metadata["packages"] if (package["name"], package["version"]) in compiled]

problems, versions = [], defaultdict(list)
for package in packages:
    name = f"{package['name']} {package['version']}"
    versions[package["name"]].append(package["version"])
    if package["id"] in metadata["workspace_members"]:
        continue
    if not package["license"] or not is_allowed(package["license"], allowed | exceptions.get(package["name"], set())):
        problems.append(f"{name}: licence {package['license']}, which deny.toml does not allow")
    if not (package["source"] or "").startswith("registry+"):
        problems.append(f"{name}: from {package['source']}, not from the crate registry")
    if package["rust_version"] and version(package["rust_version"]) > version(rust):
        problems.append(f"{name}: needs Rust {package['rust_version']}, newer than rust-version {rust}")

twice = {name: found for name, found in versions.items() if len(found) > 1}
print(f"{len(packages)} crates; several versions of {len(twice)}:", ", ".join(sorted(twice)))
print("\n".join(problems) or f"licences, sources and Rust versions (at most {rust}): as they should be")
sys.exit(bool(problems))
