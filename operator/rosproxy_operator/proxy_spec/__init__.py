"""What a proxy is told and may be asked for: the same on each engine."""
