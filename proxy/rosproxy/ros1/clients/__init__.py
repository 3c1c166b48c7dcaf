"""What the proxy calls: the real master, and nodes."""
