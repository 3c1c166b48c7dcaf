{{/*
Combinations of values that have no effect, or that can't work. Which values there are at all, and what
each may be, is in values.schema.json.
*/}}
{{- define "rosproxy.checks" -}}
{{- $ports := list (int .Values.webhook.port) (int .Values.metricsPort) (int .Values.livenessPort) }}
{{- if ne (len (uniq $ports)) 3 }}
{{- fail (printf "webhook.port, metricsPort, livenessPort: the ports %v are not different. Choose three different ports" $ports) }}
{{- end }}
{{- if and .Values.networkPolicy.metricsFrom (not .Values.networkPolicy.enabled) }}
{{- fail "networkPolicy.metricsFrom: no NetworkPolicy has these peers. Set networkPolicy.enabled: true, or remove the peers" }}
{{- end }}
{{- if and .Values.proxy.networkPolicy.metricsFrom (not .Values.proxy.networkPolicy.enabled) }}
{{- fail "proxy.networkPolicy.metricsFrom: no NetworkPolicy has these peers. Set proxy.networkPolicy.enabled: true, or remove the peers" }}
{{- end }}
{{- $certificate := .Values.webhook.certificate }}
{{- if and $certificate.certManager.issuerRef (eq $certificate.source "self-signed") }}
{{- fail "webhook.certificate.certManager.issuerRef: the operator creates the certificate itself. Set webhook.certificate.source: cert-manager, or remove issuerRef" }}
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
