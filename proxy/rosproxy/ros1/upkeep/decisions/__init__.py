"""Decisions from the data of the master, the nodes and an operator, without I/O."""
