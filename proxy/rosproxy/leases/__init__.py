"""Ports of the range: which there are, which are free, and how outside sees them."""
