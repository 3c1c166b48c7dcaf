"""The proxy's ports: which of them leads to which locator, also after the proxy was killed."""
