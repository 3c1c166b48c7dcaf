{{/*
Combinations of values that have no effect, or that can't work. Which values there are at all, and what
each may be, is in values.schema.json.
*/}}
{{- define "rosproxy.checks" -}}
{{- if .Chart.IsRoot }}
{{- range $key := keys (omit .Values.global "imageRegistry" "imagePullSecrets") | sortAlpha }}
{{- fail (printf "global.%s: is unknown, and the release has no other chart. Use global.imageRegistry or global.imagePullSecrets, or remove global.%s" $key $key) }}
{{- end }}
{{- end }}
{{- /* The schema takes null as a missing value. */}}
{{- $needed := dict "image.repository" .Values.image.repository
  "proxy.image.repository" .Values.proxy.image.repository
  "tests.ros" .Values.tests.ros "tests.timeoutSeconds" .Values.tests.timeoutSeconds }}
{{- $ofTest := get (dict "1" "image" "2" "ros2Image") (toString .Values.tests.ros) }}
{{- with $ofTest }}
{{- $_ := set $needed (printf "tests.%s" .) (get $.Values.tests .) }}
{{- end }}
{{- range $path, $value := $needed }}
{{- if not $value }}
{{- fail (printf "%s: is null, which removes the default. Set a value, or remove %s from your values" $path $path) }}
{{- end }}
{{- end }}
{{- $ports := list (int .Values.webhook.port) (int .Values.metricsPort) (int .Values.livenessPort) }}
{{- if ne (len (uniq $ports)) 3 }}
{{- fail (printf "webhook.port, metricsPort, livenessPort: the ports %v are not different. Choose three different ports" $ports) }}
{{- end }}
{{- /* The defaults of values.yaml. Empty defaults are not listed. */}}
{{- $certificate := .Values.webhook.certificate }}
{{- $certManager := dict "duration" "2160h" "renewBefore" "720h" }}
{{- $selfSigned := dict "source" "self-signed"
  "certManager" (mustMerge (dict "issuerRef" (dict)) $certManager) }}
{{- $defaults := dict
  "webhook" (dict "timeoutSeconds" 5 "failurePolicy" "Ignore" "port" 9443 "certificate" $selfSigned)
  "dashboard" (dict "labels" (dict "grafana_dashboard" "1"))
  "podDisruptionBudget" (dict "maxUnavailable" 1) }}
{{- range $group := list "webhook" "serviceMonitor" "podMonitor" "prometheusRule" "dashboard" "podDisruptionBudget" "networkPolicy" }}
{{- $values := get $.Values $group }}
{{- if not $values.enabled }}
{{- include "rosproxy.unused" (dict "group" $group "values" $values "defaults" (get $defaults $group)
  "if" (printf "%s.enabled: true" $group)) }}
{{- end }}
{{- end }}
{{- with .Values.proxy.networkPolicy }}
{{- if not .enabled }}
{{- include "rosproxy.unused" (dict "group" "proxy.networkPolicy" "values" .
  "if" "proxy.networkPolicy.enabled: true") }}
{{- end }}
{{- end }}
{{- if eq $certificate.source "self-signed" }}
{{- include "rosproxy.unused" (dict "group" "webhook.certificate.certManager"
  "values" $certificate.certManager "defaults" $certManager
  "if" "webhook.certificate.source: cert-manager") }}
{{- end }}
{{- range $ros, $image := dict "1" (dict "image" "ros:noetic-ros-core-focal")
  "2" (dict "ros2Image" "ros:jazzy-ros-core") }}
{{- if ne $ros (toString $.Values.tests.ros) }}
{{- include "rosproxy.unused" (dict "group" "tests" "values" (pick $.Values.tests (keys $image | first))
  "defaults" $image "if" (printf "tests.ros: %s" $ros)) }}
{{- end }}
{{- end }}
{{- if and (eq .Values.policy.mode "Audit") (not .Values.policy.rules) }}
{{- fail "policy.mode: has no effect without rules. Add policy.rules, or remove policy.mode" }}
{{- end }}
{{- if not (or .Values.crds.install .Values.crds.keep) }}
{{- fail "crds.keep: has no effect if the release does not have the definition. Set crds.install: true, or remove crds.keep" }}
{{- end }}
{{- with .Values.serviceAccount }}
{{- if and (not .create) (not .name) }}
{{- fail "serviceAccount.name: is empty, and the chart creates no ServiceAccount. Name an existing ServiceAccount, or set serviceAccount.create: true" }}
{{- end }}
{{- if and (not .create) .annotations }}
{{- fail "serviceAccount.annotations: the chart creates no ServiceAccount. Annotate your ServiceAccount, or set serviceAccount.create: true" }}
{{- end }}
{{- end }}
{{- if and .Values.rbac.aggregate (not .Values.rbac.create) }}
{{- fail "rbac.aggregate: the chart creates no roles. Set rbac.create: true, or remove rbac.aggregate" }}
{{- end }}
{{- end -}}

{{/*
Refuse values that have no effect, from a dict: group (their path), values, defaults, and "if", the value
with which they have an effect. A default passes.
*/}}
{{- define "rosproxy.unused" -}}
{{- range $key, $value := .values }}
{{- if and $value (ne (toJson $value) (toJson (get (default dict $.defaults) $key))) }}
{{- fail (printf "%s.%s: has an effect only with %s. Set this value, or remove %s.%s" $.group $key (get $ "if") $.group $key) }}
{{- end }}
{{- end }}
{{- end -}}
