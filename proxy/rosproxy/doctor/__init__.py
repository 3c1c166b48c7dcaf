"""``rosproxy doctor``: why can't A hear B? `collect` gathers facts, and rules judge the facts."""
