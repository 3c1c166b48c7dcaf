"""What is changed in the messages that pass."""
