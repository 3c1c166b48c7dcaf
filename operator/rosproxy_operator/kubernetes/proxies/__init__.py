"""What the operator and its proxies tell each other, and what Events say of their pods."""
