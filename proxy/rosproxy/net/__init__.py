"""Sockets, HTTP, names and addresses: what every protocol that is proxied needs of the network."""
