"""How far the source of a datagram is believed, and how much of the proxy's time it gets."""
