"""Metrics, and refusals above a bound."""
