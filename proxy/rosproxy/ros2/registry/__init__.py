"""The participants of each side, and their readers and writers."""
