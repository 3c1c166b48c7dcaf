"""Which nodes are behind the proxy, what each has registered, and the port that stands for it."""
