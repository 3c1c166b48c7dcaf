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
{{- default "default" .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}

{{/* An image's full name, from a dict: image (the value), default (the tag, if none is given). */}}
{{- define "rosproxy.image" -}}
{{- if .image.digest -}}
{{- printf "%s@%s" .image.repository .image.digest -}}
{{- else -}}
{{- printf "%s:%s" .image.repository (default .default .image.tag) -}}
{{- end -}}
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
{{- $namespace := dict "matchLabels" (dict "kubernetes.io/metadata.name" .Release.Namespace) -}}
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
  namespace: {{ .Release.Namespace }}
{{- end -}}
