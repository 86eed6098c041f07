#!/usr/bin/env bash
# Installs all packages of the pipeline on Debian 12, Debian 13 or Ubuntu 24.04. A repeated call takes seconds.
#   bash setup.sh [run|quick|test]
#   run    then generates the datasets of the configuration configs/starter.yaml
#   quick  then checks style and types, and runs the short tests
#   test   then checks style and types, and runs all tests, one of them in a browser
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

UV_VERSION=0.13.8
# Versions of Python that the lock supports, in the order of the search.
PYTHONS=(3.11 3.12 3.13)
VERB=${1:-}

fail() { printf 'setup.sh: %s\n' "$@" >&2; exit 1; }

# Ends after the message of a failed tool. A full disk is named first: a tool frees its files again when it fails.
stopped() {
    local folder free_mb cache=${UV_CACHE_DIR:-$HOME/.cache/uv}
    for folder in . "${TMPDIR:-/tmp}" "${UV_CACHE_DIR:-$HOME}"; do
        free_mb=$(df --output=avail --block-size=1M "$folder" 2>/dev/null | tail -n 1) || continue
        ((free_mb > 2000)) ||
            fail "$1; only $((free_mb)) MB are free at $folder" "  try: free 10 GB there, then run setup.sh again"
    done
    fail "$1; see the reason above" \
        "  try: check the network and the mirror in pip's configuration; if the cache $cache is broken," \
        "       set UV_CACHE_DIR to an empty folder"
}

version_of() { "$1" -c 'import sys; print(*sys.version_info[:2], sep=".")' 2>/dev/null || true; }

find_python() {
    local wanted candidate conda=${CONDA_EXE:-}
    for wanted in "${PYTHONS[@]}"; do
        # Keep a finished installation. Replace an unfinished one, because uv would take it for finished.
        if [[ -e .venv/installed && ! -e .venv/unfinished && -x .venv/bin/pip && $(version_of .venv/bin/python) == "$wanted" ]]; then
            echo .venv/bin/python
            return
        fi
    done
    for wanted in "${PYTHONS[@]}"; do
        # PATH has pyenv's shims also for missing versions, so start each candidate and ask for its version.
        for candidate in "python$wanted" python3 python "${PYENV_ROOT:-$HOME/.pyenv}/versions/$wanted".*/bin/python \
            "${conda%/bin/conda}"/{,envs/*/}bin/python; do
            if [[ $(version_of "$candidate") == "$wanted" ]]; then
                echo "$candidate"
                return
            fi
        done
    done
    fetch_python || fail "found no Python ${PYTHONS[*]}, and uv could not fetch one" \
        "  try: sudo apt-get install -y python3 python3-venv"
}

# Fetches Python with uv, which any Python 3 installs.
fetch_python() {
    local uv
    if ! uv=$(command -v uv); then
        uv=$(mktemp -d)
        { python3 -m venv "$uv" && "$uv/bin/pip" install --quiet "uv==$UV_VERSION"; } >&2 || return 1
        uv=$uv/bin/uv
    fi
    "$uv" python install "${PYTHONS[0]}" >&2 && "$uv" python find --managed-python "${PYTHONS[0]}"
}

# Searches for the libraries themselves, because they may be installed without dpkg.
missing_packages() {
    local libraries
    libraries=$(PATH=$PATH:/usr/sbin:/sbin ldconfig -p)
    has() { grep -qE "$1" <<<"$libraries"; }
    has '\blibEGL\.so\.1' || echo libegl1
    has '\blibEGL_(mesa|nvidia)\.so\.0' || echo libegl-mesa0
    has '\blibGL\.so\.1' || echo libgl1
    has '\blibOSMesa\.so' || echo libosmesa6
    has '\blibgthread-2\.0\.so\.0' || echo libglib2.0-0   # OpenCV
    has '\blibMagickWand-.*\.so' || echo imagemagick   # the tests' reference for the benchmark's noise
    has '\blibavcodec\.so' || echo ffmpeg   # torchcodec, which also links libpython; later versions of lerobot do not
    [[ $VERSION != 3.11 ]] || "$PYTHON" -c 'import ctypes; ctypes.CDLL("libpython3.11.so.1.0")' 2>/dev/null ||
        echo libpython3.11
    command -v git >/dev/null || echo git
    # Browser and batch system of the tests; `quick` skips the tests that need them.
    [[ $VERB != test ]] || command -v chromium-headless-shell >/dev/null || echo chromium-headless-shell
    [[ $VERB != test || -x /usr/sbin/slurmctld ]] || echo slurm-wlm
    "$PYTHON" -c 'import ensurepip' 2>/dev/null || echo "python$VERSION-venv"
}

install_packages() {
    local as_root=() install=(apt-get install -y --no-install-recommends "$@")
    if [[ $(id -u) != 0 ]]; then as_root=(sudo -n); fi
    if ! command -v apt-get >/dev/null || ! "${as_root[@]}" true 2>/dev/null; then
        fail "these Debian packages are missing, and their installation requires root: $*" "  try: sudo ${install[*]}"
    fi
    # One broken third-party source must not stop the others.
    "${as_root[@]}" apt-get update -qq || true
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive "${install[@]}" -qq ||
        stopped "apt-get could not install $*"
}

install_venv() {
    local index
    if [[ $PYTHON != .venv/bin/python ]]; then
        # Only delete what a first call left unfinished. Another environment may have the user's packages.
        if [[ -L .venv || (-e .venv && ! -e .venv/of_setup) ]]; then
            move_aside "this script did not create it"
        elif [[ -e .venv/installed ]]; then
            move_aside "an update of it was not finished, or its Python is gone"
        fi
        rm -rf .venv
        "$PYTHON" -m venv .venv || stopped "$PYTHON could not create .venv"
        touch .venv/of_setup
    fi
    touch .venv/unfinished
    .venv/bin/pip install --quiet "uv==$UV_VERSION" || stopped "pip could not install uv"
    # uv does not read pip's configuration: pass it the mirror of this configuration.
    index=${PIP_INDEX_URL:-$(.venv/bin/pip config get global.index-url 2>/dev/null || true)}
    if [[ -n $index ]]; then export UV_DEFAULT_INDEX=${UV_DEFAULT_INDEX:-$index}; fi
    export VIRTUAL_ENV=$PWD/.venv
    # Compile once. Otherwise, if PYTHONDONTWRITEBYTECODE is set, each process would compile torch and others again.
    .venv/bin/uv pip sync --compile-bytecode --require-hashes requirements.lock ||
        stopped "uv could not install requirements.lock"
    # The lock holds the build back end, so the package itself needs no network.
    .venv/bin/uv pip install --quiet --no-deps --no-build-isolation --editable . ||
        stopped "uv could not install this package"
    # Compile Numba's loops once, instead of in every worker of the first run. `doctor` later reports missing renderers.
    .venv/bin/python -m pipeline.validation.loops || true
}

move_aside() {
    local aside
    aside=.venv.$(date +%Y%m%d%H%M%S)
    mv .venv "$aside"
    echo "setup.sh: moved .venv to $aside, because $1"
}

[[ $VERB =~ ^(run|quick|test|)$ ]] || fail "unknown verb '$VERB', expected run, quick, test or none"
# The lock only has packages for this platform.
[[ $(uname -sm) == "Linux x86_64" ]] || fail "this machine is $(uname -sm), not Linux x86_64"
PYTHON=$(find_python)
VERSION=$(version_of "$PYTHON")
packages=$(missing_packages)
if [[ -n $packages ]]; then
    # shellcheck disable=SC2086  # one word per package
    install_packages $packages
fi

stamp=$(cat setup.sh requirements.lock pyproject.toml | sha256sum)
if [[ ! -x .venv/bin/python || -e .venv/unfinished || $(cat .venv/installed 2>/dev/null) != "$stamp" ]]; then
    install_venv
    echo "$stamp" >.venv/installed
    rm .venv/unfinished
fi

# The stages of DVC call `python`.
export PATH=$PWD/.venv/bin:$PATH
case $VERB in
run)
    python -m pipeline run configs/starter.yaml
    ;;
quick | test)
    ruff check
    ruff format --check
    # Check types next to the tests, whose two processes are not always busy.
    mypy &
    types=$!
    # Two processes take one module at a time. tests/conftest.py puts the longest modules first.
    together=(-n 2 --dist loadfile --no-loadscope-reorder)
    # Each process uses one core, as the workers of a run do.
    export LP_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
    chosen=()
    [[ $VERB == test ]] || chosen=(-m "not slow")
    failed=0
    pytest "${together[@]}" "${chosen[@]}" || failed=1
    # Wait for the types after a failed test, too: their faults count, and no process is left behind.
    wait "$types" || failed=1
    exit "$failed"
    ;;
esac
