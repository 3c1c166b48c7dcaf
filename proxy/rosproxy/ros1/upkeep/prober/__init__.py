"""Are the nodes alive? Dead ones are unregistered, and the ports that nobody uses are freed."""
