#!/usr/bin/env bash
# Make a virtual environment with an editable rosproxy.
#   scripts/venv.sh DIR [EXTRAS]      for example: scripts/venv.sh .venv dev,uvloop
# PYTHON names the interpreter. The default is the first Python >= 3.11 in PATH.
set -euo pipefail
cd "$(dirname "$0")/.."

recent() {
  "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
}

find_python() {
  local name
  for name in ${PYTHON:-python3 python3.13 python3.12 python3.11 /usr/bin/python3}; do
    if recent "$name"; then
      command -v "$name"
      return
    fi
  done
  echo "rosproxy needs Python 3.11 or newer, and neither python3 nor python3.11 to python3.13 is" \
    "one. Install it (Ubuntu 22.04: sudo apt-get install python3.11 python3.11-venv), or name it:" \
    "make PYTHON=/path/to/python3 ..." >&2
  return 1
}

# Debian and Ubuntu ship `venv` in a separate package.
install_venv_module() {
  local package
  package="python$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
  if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
    echo "$1 has no working venv module. On Debian or Ubuntu: sudo apt-get install $package" >&2
    return 1
  fi
  echo "installing $package" >&2
  apt-get update -qq >&2
  DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends "$package" >/dev/null
}

make_venv() {
  "$1" -c 'import ensurepip, venv' 2>/dev/null || install_venv_module "$1"
  rm -rf "$2"
  "$1" -m venv "$2"
}

directory=$1
if ! recent "$directory/bin/python" || ! "$directory/bin/python" -m pip --version >/dev/null 2>&1; then
  python=$(find_python)
  make_venv "$python" "$directory"
fi
pins=$(mktemp)
trap 'rm -f "$pins"' EXIT
"$directory/bin/python" scripts/pins.py "build-system,${2:-}" >"$pins"
install=("$directory/bin/python" -m pip install --quiet --disable-pip-version-check)
# Wheels only: an archive of sources would run code with unpinned build requirements.
"${install[@]}" --only-binary :all: --require-hashes --requirement "$pins"
"${install[@]}" --no-deps --no-build-isolation --editable .
