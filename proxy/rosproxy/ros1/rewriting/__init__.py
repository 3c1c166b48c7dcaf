"""Addresses of one side made into the other's, in calls and replies. Pure."""
