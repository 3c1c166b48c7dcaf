"""Rewrites addresses of one side for the other side, in calls and replies. Pure."""
