"""What becomes of a datagram: pure decisions over the participants of a domain."""
