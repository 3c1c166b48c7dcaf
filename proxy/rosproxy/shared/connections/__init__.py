"""TCP sockets, and the bounds on what each source may hold."""
