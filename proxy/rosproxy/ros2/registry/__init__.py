"""Who is there on each side, and which ports of the range lead to whom."""
