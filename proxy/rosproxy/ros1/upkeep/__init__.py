"""What happens by the clock or by an event rather than by a node's call.

Where to look:

- Dead nodes stay in ``rosnode list``, a port refuses or is not freed: `prober`.
- The master was restarted or can't be reached: `master_monitor`.
- After a start of the proxy nodes are missing, or have other ports: `recovery`.
- A subscriber hears nothing after the proxy or a node was away: `resubscriber`.
- A node registered around the proxy, or was shut down for it: `adopter`.
- A container went, moved or arrived, or the proxy is to retire: `containers`.
- What the proxy itself registers and unregisters at the master: `registrar`.

Data goes one way: an answer of the master or a node is read by a client, a module of `decisions`
says what follows, and the `Registrar` makes the calls. Nothing below knows who asked for it.
"""
