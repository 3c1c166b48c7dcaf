"""The ports of the proxy: which port leads to which locator, also after the proxy was killed."""
