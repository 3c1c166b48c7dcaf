"""Watches the objects of the cluster and keeps the state."""
