"""The policy over readers and writers: which rule applies, and what it says."""
