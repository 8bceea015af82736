#!/bin/sh
# Makes the environment: system libraries that Open3D and pycolmap need, a virtual environment, bodyscan.
# Usage: set-up.sh PYTHON FOLDER
set -eu
python=${1:?no Python 3.11 to 3.14 found: install one, or say make PYTHON=/path/to/python3}
venv=$2

# Debian and Ubuntu ship Python without venv, and containers ship no graphics libraries.
missing=
for library in libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libgomp.so.1 libX11.so.6 libidn2.so.0; do
    ldconfig -p 2>/dev/null | grep -q "$library" || missing="$missing $library"
done
if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then missing="$missing venv"; fi
if [ -n "$missing" ] && command -v apt-get >/dev/null; then
    echo "installing system libraries (missing:$missing)"
    as_root=
    if [ "$(id -u)" != 0 ]; then as_root=sudo; fi
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    venv_package=python3-venv
    if apt-cache show "python$version-venv" >/dev/null 2>&1; then
        venv_package=python$version-venv
    fi
    case $missing in *venv*) ;; *) venv_package= ;; esac
    $as_root apt-get -o DPkg::Lock::Timeout=120 update -qq
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive $as_root apt-get -o DPkg::Lock::Timeout=120 install -y -qq --no-install-recommends \
        libusb-1.0-0 libgl1 libegl1 libgomp1 libx11-6 libidn2-0 $venv_package >/dev/null
elif [ -n "$missing" ]; then
    echo "missing system libraries:$missing (names as on Linux; install them if open3d does not load)" >&2
fi

[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable '.[dev,docs,cluster,station]'
"$venv/bin/python" -c 'import open3d, pycolmap, cv2' ||
    { echo "the libraries are installed but do not load, see the message above" >&2; exit 1; }
