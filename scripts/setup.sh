#!/usr/bin/env bash
# Make the virtual environment $VENV with everything that skope and its tests need. PIP_ARGS reaches pip.
set -euo pipefail
cd "$(dirname "$0")/.."
VENV=${VENV:-.venv}
read -r -a pip_args <<< "${PIP_ARGS:-}"

fail() { echo "setup: $*" >&2; exit 1; }

# Install Debian packages when this user may, else say which.
system_packages() {
    if ! command -v apt-get > /dev/null; then
        fail "these system packages are missing (Debian's names): $*"
    fi
    local as=()
    if [ "$(id -u)" != 0 ]; then
        sudo -n true 2> /dev/null || fail "please run: sudo apt-get install --yes $*"
        as=(sudo -n)
    fi
    echo "setup: installing $*"
    "${as[@]}" apt-get update --quiet=2
    "${as[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet=2 --no-install-recommends "$@" > /dev/null
}

# SUMO's library links against the first of these, rendering needs the last.
missing=()
while read -r library package; do
    ldconfig -p 2> /dev/null | grep -q "$library" || missing+=("$package")
done << 'LIST'
libGL.so.1 libgl1
libX11.so.6 libx11-6
libXext.so.6 libxext6
libXrender.so.1 libxrender1
libatomic.so.1 libatomic1
libEGL.so.1 libegl1
libEGL_mesa.so.0 libegl-mesa0
LIST
if command -v dpkg > /dev/null && ! dpkg --status libgl1-mesa-dri > /dev/null 2>&1; then
    missing+=(libgl1-mesa-dri)
fi
[ ${#missing[@]} = 0 ] || system_packages "${missing[@]}"

# Python 3.11 has ready-made wheels of everything; a later one compiles pybullet.
python=
for candidate in python3.11 python3.12 python3.13 python3; do
    if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2> /dev/null; then
        python=$candidate
        break
    fi
done
[ -n "$python" ] || fail "Python 3.11 or later is needed: install python3.11 and python3.11-venv, then run this again"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
if [ "$version" != 3.11 ]; then
    echo "setup: Python $version: pybullet has no wheel for it and will be compiled, which takes about 5 minutes" \
        "and needs g++ and Python's headers (Debian: g++ python$version-dev); Python 3.11 needs neither"
    command -v g++ > /dev/null || system_packages g++ "python$version-dev"
fi
if ! "$python" -c 'import ensurepip, venv' 2> /dev/null; then
    system_packages "python$version-venv"
fi

echo "setup: virtual environment $VENV with Python $version; about 3.8 GB to download, 7.8 GB on disk"
[ -x "$VENV/bin/python" ] || "$python" -m venv "$VENV"
"$VENV/bin/python" -m pip install --quiet "${pip_args[@]}" --constraint constraints.txt --editable '.[dev]'
"$VENV/bin/skope" --version
