{{/* What the operator changes: everywhere, or in the namespaces that are named. */}}
{{- define "rosproxy.writeRules" -}}
# Proxies are pods: created for the nodes that need one, deleted when they don't, and patched for one
# thing, another image.
- apiGroups: [""]
  resources: [pods]
  verbs: [create, delete, patch]
# A pod that was not wired is evicted, where its RosProxy asks for that.
- apiGroups: [""]
  resources: [pods/eviction]
  verbs: [create]
# One Service for each RosProxy, under which pods find the proxy on their own node.
- apiGroups: [""]
  resources: [services]
  verbs: [create, delete]
# One NetworkPolicy for each RosProxy: who may connect to its proxies.
- apiGroups: [networking.k8s.io]
  resources: [networkpolicies]
  verbs: [get, list, watch, create, patch, delete]
# Events on RosProxies and on pods; one that comes again is read and counted. And the kubelet's events
# on a proxy that does not start: they alone say that a port is taken.
- apiGroups: [""]
  resources: [events]
  verbs: [create, get, list, patch]
# The status of RosProxies; their spec is the user's.
- apiGroups: [rosproxy.io]
  resources: [rosproxies/status]
  verbs: [patch]
{{- end -}}
