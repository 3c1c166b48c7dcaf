"""Discovery: what the proxy does with each datagram. Pure decisions over a domain."""
