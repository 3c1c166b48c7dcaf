"""What the operator needs on every engine."""
