"""The policy for readers and writers: the rule that applies, and the verdict."""
