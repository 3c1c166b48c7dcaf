"""Nodes that registered at the master around the proxy are found and taken in."""
