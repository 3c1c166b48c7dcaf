"""The participants that the proxy serves: their places, and the owners of GUID prefixes."""
