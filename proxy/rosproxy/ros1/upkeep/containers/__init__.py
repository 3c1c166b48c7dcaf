"""Containers that went, moved or arrived, as an operator tells it."""
