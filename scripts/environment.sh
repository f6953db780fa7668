# Sourced by demo, test, gpu and consumers: makes .venv in this checkout, once, and installs the package into it.
# Defines `require_libraries PACKAGE...` and `prepare_environment EXTRAS`, which are extras of pyproject.toml or "".

find_python() {
    local name
    for name in python3 python3.13 python3.12 python3.11; do
        if "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then
            echo "$name"
            return 0
        fi
    done
    echo "mpmcli needs Python 3.11, 3.12 or 3.13, and none is on the PATH." >&2
    return 1
}

# Whether the system can load the shared library of a Debian package. Systems other than Linux bring theirs.
has_library() {
    local library
    case $1 in
        libx11-6) library=libX11.so.6 ;;
        libvulkan1) library=libvulkan.so.1 ;;
        libegl1) library=libEGL.so.1 ;;
        *) package_installed "$1"; return ;;
    esac
    "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$library" 2>/dev/null
}

package_installed() {
    ! command -v dpkg-query >/dev/null || dpkg-query -W -f='${Status}' "$1" 2>/dev/null | grep -q 'install ok installed'
}

install_packages() {
    DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@" </dev/null
}

# Looks for the system libraries of these Debian packages, before anything is downloaded. As root it installs what is
# missing. Without libx11-6, which Taichi links, nothing runs; the others serve tests that are skipped without them.
require_libraries() {
    local python package log missing=()
    [ "$(uname -s)" = Linux ] || return 0
    python=$(find_python) || return 1
    for package in "$@"; do
        has_library "$package" || missing+=("$package")
    done
    [ ${#missing[@]} -eq 0 ] && return 0
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        echo "Installing ${missing[*]} with apt-get." >&2
        log=$(mktemp)
        if { install_packages "${missing[@]}" || { apt-get update && install_packages "${missing[@]}"; }; } >"$log" 2>&1; then
            rm -f "$log"
            return 0
        fi
        echo "apt-get failed; its messages are in $log." >&2
    fi
    echo "System libraries are missing. On Debian and Ubuntu, this line installs them (as root, or with sudo):" >&2
    echo "    apt-get update && apt-get install -y --no-install-recommends ${missing[*]}" >&2
    [ "${missing[0]}" != libx11-6 ] && echo "Tests that need them are skipped." >&2
}

make_venv() {
    local python
    python=$(find_python) || return 1
    echo "Making .venv with $("$python" --version)." >&2
    if ! "$python" -m venv --clear .venv >&2; then
        echo "Making .venv failed, see above (Debian and Ubuntu need the package python3-venv)." >&2
        return 1
    fi
}

# What an installation depends on; a change of any of these installs again.
installation_stamp() {
    { pwd; .venv/bin/python --version; cat pyproject.toml constraints.txt; } | cksum
}

prepare_environment() {
    local extra=$1 target=. stamp_file stamp
    [ -n "$extra" ] && target=".[$extra]"
    stamp_file=".venv/installed-${extra:-core}"
    .venv/bin/python -m pip --version >/dev/null 2>&1 || make_venv || return 1
    stamp=$(installation_stamp)
    [ "$(cat "$stamp_file" 2>/dev/null)" = "$stamp" ] && return 0
    # The test extra has all that the package alone needs.
    [ -z "$extra" ] && [ "$(cat .venv/installed-test 2>/dev/null)" = "$stamp" ] && return 0
    echo "Installing mpmcli and its dependencies into .venv. The first time takes a minute or two." >&2
    if ! .venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e "$target" >&2; then
        echo "Installing failed, see pip's message above; nothing outside .venv was changed." >&2
        return 1
    fi
    echo "$stamp" >"$stamp_file"
}
