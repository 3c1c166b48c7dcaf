"""Ports of the range: which there are, who holds them, and how outside sees them."""
