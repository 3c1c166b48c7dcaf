"""The documents of the admin endpoint: status, bodies of calls, and findings. All pure."""
