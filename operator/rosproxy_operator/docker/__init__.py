"""The controller of one Docker host."""
