"""Sockets: datagrams in, and out."""
