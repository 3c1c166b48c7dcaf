"""The admin endpoint: health, metrics, status, and the calls of an operator."""
