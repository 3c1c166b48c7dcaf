#!/usr/bin/env bash
# Pin everything that CI and the images install, for each Python that rosproxy runs on, with the
# hashes of all files of each version.
#   scripts/lock.sh constraints.txt
set -euo pipefail
cd "$(dirname "$0")/.."
target=$1
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip --disable-pip-version-check install --quiet uv
{
  echo "# Written by \`make lock\`. Versions that the tests ran with; pyproject.toml has the floors."
  # The build backend is pinned with the rest, so that an image built later is the same image.
  "$work/venv/bin/python" -c 'import tomllib
with open("pyproject.toml", "rb") as project:
    print(*tomllib.load(project)["build-system"]["requires"], sep="\n")' |
    "$work/venv/bin/uv" pip compile --quiet --no-header --universal --fork-strategy fewest \
      --python-version 3.11 --generate-hashes --all-extras pyproject.toml -
} >"$work/constraints.txt"
if grep -n ' @ \|://' "$work/constraints.txt"; then
  echo "a pin names a place instead of a version" >&2
  exit 1
fi
cp "$work/constraints.txt" "$target"

# The separate environments of the test layers ros2 and zenoh. Without empy, which is available as
# sources only, and which only code generators need.
for wanted in tests/{ros2,zenoh}/environments/*.in; do
  "$work/venv/bin/uv" pip compile --quiet --no-header --universal --python-version 3.11 \
    --generate-hashes --no-emit-package empy --output-file "${wanted%.in}.txt" "$wanted"
done
