"""Requests to the API server, and the gate that stops changes."""
