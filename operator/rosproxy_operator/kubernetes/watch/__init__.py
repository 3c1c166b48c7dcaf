"""The cluster as its watches tell it."""
