"""Ports of the proxy that stand in for nodes on the master's host, under the master's name."""
