#!/usr/bin/env bash
# Write what is made from the chart: manifests/install.yaml, its README.md, and the tables of the
# RosProxy's fields in docs/; and that of the proxy's settings.
#   scripts/manifests.sh [DIRECTORY]      manifest and README go there instead, and the tables stay
# Needs helm and helm-docs: those of the cluster's programs (scripts/install-kubernetes.sh), else the
# PATH's.
set -euo pipefail
cd "$(dirname "$0")/.."
manifests=${1:-manifests}
readme=${1:-charts/rosproxy-operator}/README.md
bin=${CLUSTER_BIN:-${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/cluster}
PATH=$bin:$PATH
namespace=rosproxy-system

{
  echo "# Made from charts/rosproxy-operator by scripts/manifests.sh: don't change it here."
  printf -- '---\napiVersion: v1\nkind: Namespace\nmetadata:\n  name: %s\n' "$namespace"
  # A helm that was not built by its own makefile takes the cluster for an ancient one.
  helm template rosproxy charts/rosproxy-operator --namespace "$namespace" --kube-version 1.30.0 --no-hooks --set crds.keep=false |
    sed -e '/^# Source: /d' -e 's/app.kubernetes.io\/managed-by: Helm/app.kubernetes.io\/managed-by: kubectl/' \
      -e '/helm.sh\/chart: /d'
} >"$manifests/install.yaml"

helm-docs --log-level error --dry-run --chart-search-root charts --sort-values-order file >"$readme"

if [ $# = 0 ]; then
  "${PYTHON:-.venv/bin/python}" scripts/custom_resource_docs.py
  "${PYTHON:-.venv/bin/python}" -m scripts.options_docs
fi
