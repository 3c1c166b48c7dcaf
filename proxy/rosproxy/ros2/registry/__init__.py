"""What the proxy knows of the participants on each side, and of their readers and writers."""
