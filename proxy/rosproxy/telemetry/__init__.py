"""What the proxy says of itself: logs, metrics, and the problems that a user should know."""
