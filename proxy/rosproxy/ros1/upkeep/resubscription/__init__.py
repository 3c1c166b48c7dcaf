"""Subscribers whose connection was lost unnoticed are told of their publishers again."""
