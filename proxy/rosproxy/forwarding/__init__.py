"""Moving the bytes of a connection: by splice in user space, or by the kernel alone."""
