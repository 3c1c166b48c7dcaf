#!/usr/bin/env bash
# Write what is made from the chart: manifests/install.yaml, and the tables of docs/kubernetes.md.
#   scripts/manifests.sh [DIRECTORY]      the manifest goes there instead, and the tables stay
# Needs helm: that of the cluster's programs (scripts/install-kubernetes.sh), else the PATH's.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:-manifests}
bin=${CLUSTER_BIN:-${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/cluster}
PATH=$bin:$PATH
namespace=rosproxy-system

{
  echo "# Made from charts/rosproxy by scripts/manifests.sh: don't change it here."
  printf -- '---\napiVersion: v1\nkind: Namespace\nmetadata:\n  name: %s\n' "$namespace"
  # A helm that was not built by its own makefile takes the cluster for an ancient one.
  helm template rosproxy charts/rosproxy --namespace "$namespace" --kube-version 1.30.0 --no-hooks |
    sed -e '/^# Source: /d' -e 's/app.kubernetes.io\/managed-by: Helm/app.kubernetes.io\/managed-by: kubectl/' \
      -e '/helm.sh\/chart: /d'
} >"$target/install.yaml"

if [ $# = 0 ]; then
  "${PYTHON:-.venv/bin/python}" scripts/chart_docs.py
fi
