"""The options of a proxy and the settings that an operator gives a proxy, on each engine."""
