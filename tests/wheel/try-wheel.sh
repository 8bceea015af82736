#!/bin/sh
# Builds the wheels, installs each into an empty environment and scans something small there, away from
# the source tree: what a wheel lacks (a module, a page's template, an entry point) is missed here.
# bodyscan-core is the same but for what it asks for: neither Open3D nor pycolmap (docs/dependencies.md).
# Usage: try-wheel.sh PYTHON FOLDER-FOR-THE-WHEELS
set -eu
python=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
mkdir -p "$2"
wheels=$(cd "$2" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
source=$(cd "$here/../.." && pwd)
away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
unset PYTHONPATH
export OPENBLAS_NUM_THREADS=1 PIP_QUIET=1 PIP_DISABLE_PIP_VERSION_CHECK=1

# From a copy: setuptools would put what an earlier build left in the source tree into the wheel. What
# `init` writes are links to rigs, pipelines and data: copied as files, or the wheel would lack them.
mkdir "$away/source"
cp -RL "$source/bodyscan" "$source/pyproject.toml" "$source/README.md" "$source/LICENSE" "$away/source"
rm -f "$wheels"/bodyscan*.whl
"$python" -m pip wheel --no-deps --wheel-dir "$wheels" "$away/source"
sed -i.full -e 's/^name = "bodyscan"/name = "bodyscan-core"/' -e '/^    "open3d/d' -e '/^    "pycolmap/d' \
    "$away/source/pyproject.toml"
rm -rf "$away/source/build"
"$python" -m pip wheel --no-deps --wheel-dir "$wheels" "$away/source"
rm -rf "$away/source"
cp "$here/scan_small.py" "$away"
cd "$away"
for wheel in "$wheels"/bodyscan-*.whl "$wheels"/bodyscan_core-*.whl; do
    "$python" -m venv --clear "$away/venv"
    "$away/venv/bin/python" -m pip install "$wheel"
    "$away/venv/bin/python" scan_small.py
done
