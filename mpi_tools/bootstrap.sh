#!/usr/bin/env bash
# Sets up eddies in this checkout, in .venv: MPI, parallel HDF5 with h5py, the pinned Python packages, and eddies with its
# compiled kernels. It can be repeated and interrupted, and does nothing if nothing has changed.
#   EDDIES_PYTHON  the Python to use (3.11 or newer); default: the first of python3, python3.13, .12, .11
#   HDF5_DIR       parallel HDF5, built with the mpicc on the PATH; default: Debian's, or that of h5pcc
# On a cluster load the modules for MPI and parallel HDF5 first: system packages are added only where one is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
checkout=$PWD
venv=$checkout/.venv
constraints=mpi_tools/constraints.txt
cache=${XDG_CACHE_HOME:-$HOME/.cache}/eddies

say() { echo "bootstrap: $*"; }
fail() { echo "bootstrap: $*" >&2; exit 1; }
have() { command -v "$1" > /dev/null 2>&1; }

fingerprint() {
    { cat setup.cfg setup.py src/eddies/kernels/*.[ch]pp $constraints mpi_tools/bootstrap.sh; echo "$checkout"
      "$venv/bin/python" -V; } 2>&1 | sha256sum
}

# ---- system packages

find_python() {
    for python in ${EDDIES_PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if have "$python" && "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
            echo "$python"
            return
        fi
    done
}

mpi_flavour() {  # its name in Debian packages
    if mpicc --showme:version > /dev/null 2>&1; then echo openmpi; else echo mpich; fi
}

find_hdf5() {
    local folder candidates=(/usr/lib/*-linux-gnu/hdf5/"$(mpi_flavour)")
    if have h5pcc; then candidates+=("$(dirname "$(dirname "$(command -v h5pcc)")")"); fi
    if [ -n "${HDF5_DIR:-}" ]; then candidates=("$HDF5_DIR"); fi
    for folder in "${candidates[@]}"; do
        if [ -e "$folder/include/hdf5.h" ]; then
            echo "$folder"
            return
        fi
    done
}

check_settings() {
    if [ -n "${EDDIES_PYTHON:-}" ] && [ -z "$(find_python)" ]; then
        fail "EDDIES_PYTHON=$EDDIES_PYTHON is not Python 3.11 or newer"
    elif [ -n "${HDF5_DIR:-}" ] && [ -z "$(find_hdf5)" ]; then
        fail "HDF5_DIR=$HDF5_DIR has no include/hdf5.h"
    fi
}

missing_packages() {
    local python
    python=$(find_python)
    if ! have mpicc || ! have mpirun; then echo openmpi-bin libopenmpi-dev libhdf5-openmpi-dev
    elif [ -z "$(find_hdf5)" ]; then echo "libhdf5-$(mpi_flavour)-dev"; fi
    if ! have gcc || ! have "${CXX:-g++}"; then echo gcc g++ libc6-dev; fi
    if [ -z "$python" ]; then echo python3 python3-venv python3-dev; return; fi
    if ! "$python" -c 'import venv, ensurepip' 2> /dev/null; then echo python3-venv; fi
    if [ ! -e "$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h" ]; then
        echo python3-dev
    fi
}

install_packages() {
    local missing as_root=()
    missing=$(missing_packages | xargs)
    if [ -z "$missing" ]; then return; fi
    if [ "$(id -u)" -ne 0 ]; then as_root=(sudo -n); fi
    if ! have apt-get || ! "${as_root[@]}" true 2> /dev/null; then
        fail "missing: $missing (names of Debian packages). Install them, or load the modules of your cluster for
MPI, parallel HDF5 (set HDF5_DIR to its folder) and Python 3.11 or newer (EDDIES_PYTHON); then run this again."
    fi
    say "installing system packages: $missing"
    "${as_root[@]}" apt-get update -qq
    # shellcheck disable=SC2086
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing > /dev/null
}

# ---- the virtual environment

make_environment() {
    local python
    python=$(find_python)
    if [ -z "$python" ]; then
        fail "Python 3.11 or newer is needed, but python3 is $(python3 -V 2>&1). Install one beside it" \
             "(Ubuntu 22.04: apt-get install python3.11-venv python3.11-dev) or set EDDIES_PYTHON to one."
    fi
    if "$venv/bin/python" -m pip --version > /dev/null 2>&1 && grep -q "$venv/bin/python" "$venv/bin/pip"; then return; fi
    say "making .venv with $("$python" -V)"
    "$python" -m venv --clear "$venv"
}

install() {
    "$venv/bin/python" -m pip install -qq --disable-pip-version-check --constraint $constraints "$@"
}

installed() {
    "$venv/bin/python" -c 'import importlib.metadata, sys; print(importlib.metadata.version(sys.argv[1]))' "$1"
}

# The wheels of h5py contain a serial HDF5. A parallel h5py is built here, and kept for each set of dependencies.
install_h5py() {
    local hdf5 key wheels build version
    hdf5=$(find_hdf5)
    if [ -z "$hdf5" ]; then fail "no parallel HDF5 found: set HDF5_DIR to its folder"; fi
    version=$(sed -n 's/^h5py==//p' $constraints)
    key=$( { mpicc -v; mpicc --showme; mpirun --version; cat "$hdf5/include/H5public.h"; echo "$hdf5"; } 2>&1 |
        cat - <("$venv/bin/python" -c 'import sys; print(sys.version)'; installed numpy; installed mpi4py) | sha256sum)
    wheels=$cache/wheels/h5py-$version-${key:0:16}
    if ! ls "$wheels"/*.whl > /dev/null 2>&1; then
        say "building h5py $version on $hdf5 (about 2 minutes, once)"
        mkdir -p "$cache/wheels"
        build=$(mktemp -d "$cache/wheels/build.XXXXXX")
        if ! CC=mpicc HDF5_MPI=ON HDF5_DIR=$hdf5 "$venv/bin/python" -m pip wheel -qq --no-build-isolation \
                --no-deps --no-binary=h5py --no-cache-dir --wheel-dir "$build" "h5py==$version"; then
            rm -rf "$build"
            fail "h5py could not be built: is $hdf5 a parallel HDF5 of $(command -v mpicc)?"
        fi
        rm -rf "$wheels"
        mv "$build" "$wheels"
    fi
    install --force-reinstall --no-deps "$wheels"/*.whl
    if ! "$venv/bin/python" -c 'import mpi4py, sys; mpi4py.rc.initialize = False
import h5py; sys.exit(not h5py.get_config().mpi)'; then
        rm -rf "$wheels"
        fail "the built h5py does not load, or has no MPI: is $hdf5 a parallel HDF5 of $(command -v mpicc)?"
    fi
}

if [ "$(cat "$venv/set-up" 2> /dev/null)" = "$(fingerprint)" ]; then exit 0; fi
mkdir -p "$cache"
if have flock; then
    exec 9> "$cache/bootstrap.lock"
    flock -n 9 || { say "waiting for another set-up to end"; flock 9; }
    if [ "$(cat "$venv/set-up" 2> /dev/null)" = "$(fingerprint)" ]; then exit 0; fi
fi
check_settings
install_packages
make_environment
say "installing Python packages (torch is large)"
install setuptools wheel cython pkgconfig numpy mpi4py
install_h5py
rm -f src/eddies/kernels/*.so  # removed, not overwritten: a running job may have loaded them
if ! install --no-build-isolation --editable '.[test,docs]'; then
    fail "eddies could not be installed, see above; its kernels need a C++17 compiler with OpenMP: install g++"
fi
fingerprint > "$venv/set-up"
say "done: .venv/bin/eddies"
