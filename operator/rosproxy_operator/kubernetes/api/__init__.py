"""The API server: how it is asked, and when nothing may be changed."""
