"""Policy: what outside may see and do, and what inside may take from outside. Pure."""
