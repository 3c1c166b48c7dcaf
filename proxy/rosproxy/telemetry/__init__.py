"""Logs, metrics, and the problems that a user should know."""
