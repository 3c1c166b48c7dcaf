"""The nodes behind the proxy, the registrations of each node, and its port."""
