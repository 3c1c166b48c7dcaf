"""Text for logs and terminals, and the problems that a user should know."""
