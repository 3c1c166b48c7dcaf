{{/*
The name of what belongs to this release: "rosproxy-operator" for the release rosproxy, else with the
release's name before it. 40 characters leave room for suffixes.
*/}}
{{- define "rosproxy.fullname" -}}
{{- if .Values.fullnameOverride -}}
{{- .Values.fullnameOverride | trunc 40 | trimSuffix "-" -}}
{{- else -}}
{{- $name := default .Chart.Name .Values.nameOverride -}}
{{- if contains $name .Release.Name -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- else if and (eq $name "rosproxy-operator") (hasSuffix "rosproxy" .Release.Name) -}}
{{- printf "%s-operator" .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- else -}}
{{- printf "%s-%s" .Release.Name $name | trunc 40 | trimSuffix "-" -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{/* The namespace of the operator. */}}
{{- define "rosproxy.namespace" -}}
{{- default .Release.Namespace .Values.namespaceOverride -}}
{{- end -}}

{{/* What the operator's pod is selected by. Never to be changed: a Deployment's selector can't be. */}}
{{- define "rosproxy.selectorLabels" -}}
app.kubernetes.io/name: {{ default .Chart.Name .Values.nameOverride | trunc 63 | trimSuffix "-" }}
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/component: operator
{{- end -}}

{{- define "rosproxy.commonLabels" -}}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version | replace "+" "_" | trunc 63 | trimSuffix "-" }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
app.kubernetes.io/part-of: rosproxy
{{- with .Values.commonLabels }}
{{ toYaml . }}
{{- end }}
{{- end -}}

{{- define "rosproxy.labels" -}}
{{ include "rosproxy.selectorLabels" . }}
{{ include "rosproxy.commonLabels" . }}
{{- end -}}

{{- define "rosproxy.serviceAccountName" -}}
{{- if .Values.serviceAccount.create -}}
{{- default (include "rosproxy.fullname" .) .Values.serviceAccount.name -}}
{{- else -}}
{{- .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}

{{/* An image's name with global.imageRegistry in the place of its registry, from a dict: root, name. */}}
{{- define "rosproxy.mirrored" -}}
{{- with .root.Values.global.imageRegistry -}}
{{ trimSuffix "/" . }}/{{ regexReplaceAll "^(localhost|[^/]*[.:][^/]*)/" $.name "" }}
{{- else -}}
{{ .name }}
{{- end -}}
{{- end -}}

{{/* An image's full name, from a dict: root, image (the value). */}}
{{- define "rosproxy.image" -}}
{{- $repository := include "rosproxy.mirrored" (dict "root" .root "name" .image.repository) -}}
{{- if .image.digest -}}
{{- printf "%s@%s" $repository .image.digest -}}
{{- else -}}
{{- printf "%s:%s" $repository (default .root.Chart.AppVersion .image.tag) -}}
{{- end -}}
{{- end -}}

{{/* Secrets for pulling an image, as JSON, from a dict: root, secrets (the value). */}}
{{- define "rosproxy.pullSecrets" -}}
{{ concat .root.Values.global.imagePullSecrets .secrets | uniq | toJson }}
{{- end -}}

{{/* The defaults for the pods of proxies, as JSON. */}}
{{- define "rosproxy.proxyPod" -}}
{{- $secrets := dict "root" . "secrets" .Values.proxy.pod.imagePullSecrets -}}
{{- $secrets = include "rosproxy.pullSecrets" $secrets | fromJsonArray -}}
{{- merge (dict "imagePullSecrets" $secrets) .Values.proxy.pod | toJson -}}
{{- end -}}

{{/* The Secret with the webhook's certificate. */}}
{{- define "rosproxy.certificateSecret" -}}
{{ include "rosproxy.fullname" . }}-webhook
{{- end -}}

{{/* The Secret with the key of the proxies' tokens. */}}
{{- define "rosproxy.keySecret" -}}
{{ include "rosproxy.fullname" . }}-key
{{- end -}}

{{/* Who may reach the proxies' admin port, as JSON: the operator's pod, and whom the values name. */}}
{{- define "rosproxy.adminFrom" -}}
{{- $namespace := dict "matchLabels" (dict "kubernetes.io/metadata.name" (include "rosproxy.namespace" .)) -}}
{{- $pod := dict "matchLabels" (include "rosproxy.selectorLabels" . | fromYaml) -}}
{{- $operator := dict "namespaceSelector" $namespace "podSelector" $pod -}}
{{- concat (list $operator) .Values.proxy.networkPolicy.metricsFrom | toJson -}}
{{- end -}}

{{/* Not empty if the operator makes the webhook's certificate itself. */}}
{{- define "rosproxy.selfSigned" -}}
{{- if and .Values.webhook.enabled (eq .Values.webhook.certificate.source "self-signed") -}}
true
{{- end -}}
{{- end -}}

{{/* Not empty if cert-manager makes it. */}}
{{- define "rosproxy.certManager" -}}
{{- if and .Values.webhook.enabled (eq .Values.webhook.certificate.source "cert-manager") -}}
true
{{- end -}}
{{- end -}}

{{/* Who is granted something: the operator's ServiceAccount. */}}
{{- define "rosproxy.subjects" -}}
- kind: ServiceAccount
  name: {{ include "rosproxy.serviceAccountName" . }}
  namespace: {{ include "rosproxy.namespace" . }}
{{- end -}}

{{/* How a monitor's endpoint is scraped, from the monitor's values. */}}
{{- define "rosproxy.scrape" -}}
honorLabels: {{ .honorLabels }}
{{- with .interval }}
interval: {{ . }}
{{- end }}
{{- with .scrapeTimeout }}
scrapeTimeout: {{ . }}
{{- end }}
{{- with .metricRelabelings }}
metricRelabelings:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .endpoint }}
{{ toYaml . }}
{{- end }}
{{- end -}}
