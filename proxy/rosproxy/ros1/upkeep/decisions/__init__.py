"""What follows from what the master, the nodes and an operator say: decisions without I/O."""
