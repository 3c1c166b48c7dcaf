"""The reliability of a datagram's source, and the share of the source in the proxy's time."""
