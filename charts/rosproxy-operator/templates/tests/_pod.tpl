{{/* The name of what the test makes. */}}
{{- define "rosproxy.test.name" -}}
{{ include "rosproxy.fullname" . }}-test
{{- end -}}

{{- define "rosproxy.test.namespace" -}}
{{- .Values.tests.namespace | default (first .Values.namespaces) | default (include "rosproxy.namespace" .) -}}
{{- end -}}

{{/* Everything that the test makes is gone after it, passed or not. */}}
{{- define "rosproxy.test.hook" -}}
helm.sh/hook: test
helm.sh/hook-delete-policy: before-hook-creation,hook-succeeded,hook-failed
{{- end -}}

{{/* The range of ports of the test's RosProxy is within what the operator allows. */}}
{{- define "rosproxy.test.window" -}}
{{- if ne .Values.allow.portWindow "1024-65535" }}
{{- $window := splitList "-" .Values.allow.portWindow -}}
portWindow: {first: {{ first $window }}, last: {{ last $window }}}
{{- end }}
{{- end -}}

{{/* The labels of the test's objects, from a dict: root, component. */}}
{{- define "rosproxy.test.labels" -}}
app.kubernetes.io/name: {{ default .root.Chart.Name .root.Values.nameOverride | trunc 63 | trimSuffix "-" }}-test
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .component }}
{{- end -}}

{{/*
A pod's spec, from a dict: root, args, env, restart, and whom to keep away from (apart, labels).
With the default security contexts it meets the standard "restricted".
*/}}
{{- define "rosproxy.test.pod" -}}
automountServiceAccountToken: false
restartPolicy: {{ .restart }}
terminationGracePeriodSeconds: 1
{{- $tests := .root.Values.tests }}
{{- $zenoh := eq (toString $tests.ros) "zenoh" }}
{{- $proxy := .root.Values.proxy }}
{{- $own := $tests.imagePullSecrets }}
{{- if $zenoh }}
{{- $own = concat $own (default list $proxy.pod.imagePullSecrets) | uniq }}
{{- end }}
{{- $secrets := dict "root" .root "secrets" $own }}
{{- with include "rosproxy.pullSecrets" $secrets | fromJsonArray }}
imagePullSecrets:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .root.Values.podSecurityContext }}
securityContext:
  {{- toYaml . | nindent 2 }}
{{- end }}
containers:
  - name: ros
    {{- if $zenoh }}
    image: {{ include "rosproxy.image" (dict "root" .root "image" $proxy.image) | quote }}
    {{- else }}
    {{- $image := ternary $tests.ros2Image $tests.image (eq (int $tests.ros) 2) }}
    image: {{ include "rosproxy.mirrored" (dict "root" .root "name" $image) | quote }}
    {{- end }}
    {{- with $tests.imagePullPolicy | default (ternary $proxy.image.pullPolicy "" $zenoh) }}
    imagePullPolicy: {{ . }}
    {{- end }}
    # The entry point of ROS's images sets the environment up. That of the proxy's image is rosproxy.
    {{ ternary "command" "args" $zenoh }}:
      {{- toYaml .args | nindent 6 }}
    env:
      - name: HOME
        value: /tmp
      - name: ROS_HOME
        value: /tmp/ros
      - name: ROS_LOG_DIR
        value: /tmp/ros
      - name: NODE_NAME
        value: {{ include "rosproxy.test.name" .root | replace "-" "_" }}_echo
      {{- range $name, $value := .env }}
      - name: {{ $name }}
        {{- if kindIs "string" $value }}
        value: {{ $value | quote }}
        {{- else }}
        {{- toYaml $value | nindent 8 }}
        {{- end }}
      {{- end }}
    resources:
      requests:
        cpu: 50m
        memory: 64Mi
      limits:
        memory: 512Mi
    {{- with .root.Values.securityContext }}
    securityContext:
      {{- toYaml . | nindent 6 }}
    {{- end }}
    volumeMounts:
      - name: scripts
        mountPath: /test
        readOnly: true
      - name: tmp
        mountPath: /tmp
volumes:
  - name: scripts
    configMap:
      name: {{ include "rosproxy.test.name" .root }}
  - name: tmp
    emptyDir: {}
{{- with .apart }}
affinity:
  podAntiAffinity:
    preferredDuringSchedulingIgnoredDuringExecution:
      - weight: 100
        podAffinityTerm:
          topologyKey: kubernetes.io/hostname
          labelSelector:
            matchLabels:
              {{- . | nindent 14 }}
{{- end }}
{{- with .root.Values.tests.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .root.Values.tests.tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}
