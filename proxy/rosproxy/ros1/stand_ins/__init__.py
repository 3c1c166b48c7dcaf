"""Stand-ins: ports on inside addresses of the proxy that lead to nodes outside."""
