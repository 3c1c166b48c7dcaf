"""The participants that the proxy serves: which get a place, and which a GUID prefix belongs to."""
