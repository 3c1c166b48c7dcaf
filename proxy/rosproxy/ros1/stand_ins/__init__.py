"""Ports of the proxy, on its inside addresses, that stand in for nodes outside."""
