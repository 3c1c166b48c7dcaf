"""Ports of the range: listen and advertised range, free ports, and fast ports."""
