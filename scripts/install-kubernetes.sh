#!/usr/bin/env bash
# Build the programs of a Kubernetes cluster, and install what its nodes need: the API
# server, the kubelet and the rest are Go modules, pinned in tests/kubernetes/tools.
# Kept in CLUSTER_BIN (default: a directory of the user's cache) until a pin changes:
# eight minutes the first time on two cores, nothing after that. Needs root.
set -euo pipefail
cd "$(dirname "$0")/.."
tools=tests/kubernetes/tools
bin=${CLUSTER_BIN:-${XDG_CACHE_HOME:-$HOME/.cache}/rosproxy/cluster}

declare -A package_of=(
  [containerd]=containerd [runc]=runc [iptables]=iptables [ip]=iproute2 [gcc]=gcc
  [nsenter]=util-linux [conntrack]=conntrack [sysctl]=procps
)
missing=()
for command in "${!package_of[@]}"; do
  command -v "$command" >/dev/null || missing+=("${package_of[$command]}")
done
[ -e /usr/lib/cni/ptp ] || missing+=(containernetworking-plugins)
if [ "${#missing[@]}" != 0 ]; then
  apt-get update -q
  DEBIAN_FRONTEND=noninteractive apt-get install -qy --no-install-recommends "${missing[@]}"
fi

pins=$(cat "$tools"/*/go.mod "$0" | sha256sum)
if [ "$(cat "$bin/pins" 2>/dev/null)" = "$pins" ]; then
  exit 0
fi
go=$(scripts/go.sh)
mkdir -p "$bin"
bin=$(realpath "$bin")
rm -f "$bin/pins"

# build MODULE NAME PACKAGE [FLAGS OF THE LINKER]
build() {
  echo "building $2" >&2
  (cd "$tools/$1" && CGO_ENABLED=0 "$go" build -trimpath -ldflags="-s -w ${4:-}" -o "$bin/$2" "$3")
}

# Without its version in it, no program of Kubernetes starts.
version=$(cd "$tools/kubernetes" && "$go" list -m -f '{{.Version}}' k8s.io/kubernetes)
IFS=. read -r major minor _ <<<"${version#v}"
about=k8s.io/component-base/version
flags="-X $about.gitVersion=$version -X $about.gitMajor=$major -X $about.gitMinor=$minor"
for name in kube-apiserver kube-controller-manager kube-scheduler kubelet kube-proxy kubectl; do
  build kubernetes "$name" "k8s.io/kubernetes/cmd/$name" "$flags"
done
build etcd etcd go.etcd.io/etcd/server/v3
build helm helm helm.sh/helm/v3/cmd/helm
build helm-docs helm-docs github.com/norwoodj/helm-docs/cmd/helm-docs
gcc -static -Os -s -o "$bin/pause" "$tools/pause.c"
echo "$pins" >"$bin/pins"
