#!/bin/sh
# Builds the wheel, installs it into an empty environment and scans something small there, away from
# the source tree: what the wheel lacks (a module, a page's template, an entry point) is missed here.
# Usage: try-wheel.sh PYTHON
set -eu
python=$1
here=$(cd "$(dirname "$0")" && pwd)
source=$(cd "$here/../.." && pwd)
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
unset PYTHONPATH
export OPENBLAS_NUM_THREADS=1

# From a copy: setuptools would put what an earlier build left in the source tree into the wheel.
mkdir "$away/source"
cp -R "$source/bodyscan" "$source/pyproject.toml" "$source/README.md" "$source/LICENSE" "$away/source"
"$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$away" "$away/source"
rm -rf "$away/source"
"$python" -m venv "$away/venv"
"$away/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$away"/bodyscan-*.whl
cp "$here/scan_small.py" "$source/rigs/three-pole-12.yaml" \
    "$source/data/subjects/woman_average.ply" "$away"
cd "$away"
"$away/venv/bin/python" scan_small.py
