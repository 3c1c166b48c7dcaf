"""The pure core: protocol codecs, registry, rewriting and planning, with no I/O and no clock.

Everything here is a function or a state machine over plain data. What has to happen outside
(bind a port, call a node, ask the master) is returned as data and done by the shell, the modules
one level up. An import-linter contract keeps sockets, asyncio and aiohttp out of this package.
"""
