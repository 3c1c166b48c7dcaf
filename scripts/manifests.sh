#!/usr/bin/env bash
# Write the generated files: manifests/install.yaml and the chart's README.md from the chart, and the
# tables of the RosProxy's fields and of the proxy's settings in docs/.
#   scripts/manifests.sh [DIRECTORY]      manifest and README go there instead, and the tables stay
# Needs helm and helm-docs, from the cluster's programs (scripts/install-kubernetes.sh) or from PATH.
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
  # Without --kube-version, a helm that its makefile did not build assumes an ancient cluster.
  helm template rosproxy charts/rosproxy-operator --namespace "$namespace" --kube-version 1.30.0 --no-hooks --set crds.keep=false |
    sed -e '/^# Source: /d' -e 's/app.kubernetes.io\/managed-by: Helm/app.kubernetes.io\/managed-by: kubectl/' \
      -e '/helm.sh\/chart: /d'
} >"$manifests/install.yaml"

helm-docs --log-level error --dry-run --chart-search-root charts --sort-values-order file >"$readme"

if [ $# = 0 ]; then
  "${PYTHON:-.venv/bin/python}" scripts/custom_resource_docs.py
  "${PYTHON:-.venv/bin/python}" -m scripts.options_docs
fi
