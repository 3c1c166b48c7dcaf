"""Exchange between the operator and the proxies, and Events about the pods of proxies."""
