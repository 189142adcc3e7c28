#!/usr/bin/env bash
# Installs what building and testing the Python package needs into target/python/tools, from a package index. PYTHON names
# the Python, by default python3.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
tools=$(realpath -m ../../target/python/tools)
[ -x "$tools/bin/python" ] || "${PYTHON:-python3}" -m venv "$tools"
"$tools/bin/pip" install --quiet --disable-pip-version-check \
    'maturin>=1.7,<2' numpy scipy pandas pandas-stubs mcap pytest mypy nbclient nbformat ipykernel
