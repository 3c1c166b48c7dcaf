"""Changes in the messages that pass the proxy."""
