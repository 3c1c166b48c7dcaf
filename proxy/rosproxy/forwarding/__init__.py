"""Forwards the bytes of connections and datagrams: in user space, or by the kernel alone."""
