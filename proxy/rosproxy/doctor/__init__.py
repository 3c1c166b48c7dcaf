"""``rosproxy doctor``: why can A not hear B? Facts are collected, then judged by rules."""
