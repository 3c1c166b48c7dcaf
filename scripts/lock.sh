#!/usr/bin/env bash
# Pin everything that CI and the image install: a fresh environment, frozen.
#   scripts/lock.sh constraints.txt
set -euo pipefail
cd "$(dirname "$0")/.."
target=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"${PYTHON:-python3}" -m venv "$work/venv"
pip=("$work/venv/bin/python" -m pip --disable-pip-version-check)
# The build backend is pinned with the rest, so that an image built later is the same image.
"${pip[@]}" install --quiet --upgrade '.[bench,dev,operator,uvloop]' hatchling
{
  echo "# Written by \`make lock\`. Versions that the tests ran with; pyproject.toml has the floors."
  "${pip[@]}" freeze --exclude rosproxy --exclude-editable
} >"$work/constraints.txt"
if grep -n '@\|://' "$work/constraints.txt"; then
  echo "a pin names a place instead of a version" >&2
  exit 1
fi
cp "$work/constraints.txt" "$target"
