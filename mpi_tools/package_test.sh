#!/usr/bin/env bash
# Builds the sdist and from it the wheel, installs the wheel in a new environment, and runs a short scene there, outside
# the checkout. Without a compiler, the build of the wheel must fail with a message that names the package to install.
# The environment contains only the wheel. A .pth file adds the packages of .venv, so that torch is not installed again.
# The eddies of .venv stays hidden: it is itself a .pth file, which Python reads only in an environment's own folder.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
shared=$PWD/.venv
unset PYTHONPATH
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"$shared/bin/python" -m build --no-isolation --outdir "$work" . > "$work/log" 2>&1 || { cat "$work/log" >&2; exit 1; }
if CXX=/nowhere/c++ "$shared/bin/python" -m pip wheel --no-build-isolation --no-deps --no-index --wheel-dir "$work/none" \
        "$work"/eddies-*.tar.gz > "$work/without" 2>&1; then
    echo "package_test: a wheel without kernels was built" >&2
    exit 1
fi
last=$(grep -B 1 -F '[end of output]' "$work/without" | head -1)
case $last in *"install g++ "*) ;; *) echo "package_test: without a compiler the last line is: $last" >&2; exit 1 ;; esac
"$shared/bin/python" -m venv "$work/clean"
packages='import sysconfig; print(sysconfig.get_path("purelib"))'
"$shared/bin/python" -c "$packages" > "$("$work/clean/bin/python" -c "$packages")/shared.pth"
"$work/clean/bin/python" -m pip install -qq --disable-pip-version-check --no-deps --no-index "$work"/eddies-*.whl

cd "$work"
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
found=$(clean/bin/python -c 'import eddies; print(eddies.__file__)')
case $found in "$work"/clean/*) ;; *) echo "package_test: $found is not from the wheel" >&2; exit 1 ;; esac
kernels='from eddies.kernels.library import in_use; print(in_use())'
[ "$(clean/bin/python -c "$kernels")" = "$("$shared/bin/python" -c "$kernels")" ] ||
    { echo "package_test: the wheel lacks compiled kernels" >&2; exit 1; }
clean/bin/eddies --version
clean/bin/eddies run tiny --unset variant --set kernel.steps=20 --set training.steps=20 > log || { cat log >&2; exit 1; }
[ -e runs/tiny/report/index.html ]
echo "package_test: sdist and wheel build, install and run"
