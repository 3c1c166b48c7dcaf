"""The admission webhook: pods are wired to the proxy of their node as they are made."""
