"""The announcements that the proxy sends to one side about participants of the other side."""
