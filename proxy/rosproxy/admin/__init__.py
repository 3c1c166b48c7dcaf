"""The admin endpoint: health, metrics, status, and what an operator tells the proxy."""
