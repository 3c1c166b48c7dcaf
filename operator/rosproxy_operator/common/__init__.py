"""Code that the operators of all engines share."""
