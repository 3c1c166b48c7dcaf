"""The operators, which start proxies for labelled containers and pods."""
