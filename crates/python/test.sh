#!/usr/bin/env bash
# Builds the wheel from what `cargo build --release` has compiled, installs it and tests it there:
#
#     crates/python/setup.sh    # the tools, from a package index
#     crates/python/test.sh
#
# All tests, types and the notebook with the Python of the tools; tests and examples without pandas and scipy with every
# other Python of BARE_PYTHONS, by default 3.10 and 3.13 where they are found.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
target=$(realpath ../../target)
tools=$target/python/tools
export SQUEALCAST=${SQUEALCAST:-$target/release/squealcast}
export PYTHONDONTWRITEBYTECODE=1
export XDG_CACHE_HOME=$target/python/cache    # charts

[ -x "$tools/bin/maturin" ] || { echo "no $tools: run crates/python/setup.sh"; exit 1; }
rm -rf "$target/python/wheels"
"$tools/bin/maturin" build --release --locked --quiet --interpreter "$tools/bin/python" --out "$target/python/wheels"
wheel=$(ls "$target"/python/wheels/*.whl)
echo "$(basename "$wheel"): $(($(stat -c %s "$wheel") / 1024)) KiB"

echo "== $("$tools/bin/python" --version): tests, examples, types, notebook"
"$tools/bin/pip" install --quiet --force-reinstall --no-deps "$wheel"
"$tools/bin/python" -m pytest --quiet -p no:cacheprovider tests
"$tools/bin/python" -m mypy --strict --cache-dir "$target/python/mypy" -p squealcast
"$tools/bin/python" -m mypy.stubtest --mypy-config-file pyproject.toml --allowlist tests/stubtest.txt squealcast
"$tools/bin/python" tests/notebook.py

bare_pythons() {
    local version found
    for version in 3.10 3.13; do
        found=$(ls -d ~/.pyenv/versions/"$version".*/bin/python 2>/dev/null | head -n 1)
        found=${found:-$(command -v "python$version" || true)}
        if [ -n "$found" ]; then echo "$found"; else echo "no Python $version here" >&2; fi
    done
}
for python in ${BARE_PYTHONS-$(bare_pythons)}; do
    echo "== $("$python" --version), bare: $python"
    bare=$(mktemp -d)
    "$python" -m venv "$bare"
    "$bare/bin/pip" install --quiet --disable-pip-version-check "$wheel" pytest
    "$bare/bin/python" -m pytest --quiet -p no:cacheprovider tests
    rm -rf "$bare"
done
