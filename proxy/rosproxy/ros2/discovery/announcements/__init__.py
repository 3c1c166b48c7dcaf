"""Announcements on their way: what each side is told of the participants of the other."""
