# Sourced by demo and test: makes .venv in this checkout, once, and installs the package into it.
# Defines `prepare_environment EXTRA`, EXTRA being "" or the name of an extra of pyproject.toml.

find_python() {
    local name
    for name in python3 python3.13 python3.12 python3.11; do
        if "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null; then
            echo "$name"
            return 0
        fi
    done
    echo "mpmcli needs Python 3.11, 3.12 or 3.13, and none was found on the PATH: please install one." >&2
    return 1
}

make_venv() {
    local python
    python=$(find_python) || return 1
    echo "Making .venv with $("$python" --version)." >&2
    if ! "$python" -m venv --clear .venv >&2; then
        echo "Making .venv failed, see above (on Debian and Ubuntu the package python3-venv is needed)." >&2
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
    # With the test extra installed, the package itself is installed too.
    [ -z "$extra" ] && [ "$(cat .venv/installed-test 2>/dev/null)" = "$stamp" ] && return 0
    echo "Installing mpmcli and what it needs into .venv; this takes a minute or two the first time." >&2
    if ! .venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e "$target" >&2; then
        echo "Installing failed, see pip's message above; nothing outside .venv was changed." >&2
        return 1
    fi
    echo "$stamp" >"$stamp_file"
}
