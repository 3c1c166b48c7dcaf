"""What happens by the clock or by an event rather than by a node's call.

Data goes one way: an answer of the master or a node is read by a client, a module of `decisions`
says what follows (pure: of what is seen, and the time), and the `Registrar` makes the calls, or a
port opens or refuses. Nothing below knows who asked for it.

    when                    who                looks at           decided by      what is done
    ----------------------  -----------------  -----------------  --------------  --------------
    the master answers      recovery           the master's       recovery        leases as
    first                                      graph, its nodes                   before
    --master-interval       master_monitor     the master's pid                   the next row
    its pid is new, or      registrar          the master's       registration    what it lost
    every fifth time                           graph                              is registered
    PROBE_TICK; each node:  prober             the node's pid     liveness        ports refuse,
    --probe-interval                                                              nodes and
                                                                                  leases end
    RESUBSCRIBE_TICK,       resubscriber       the graph, nodes'  resubscription  they are told
    until nobody is missed                     connections                        es
    ENFORCE_TICK, once the  policy_enforcer    the registry,      Ros1Policy      hidden, shown,
    policy has changed                         connections                        cut
    TIDY_INTERVAL           stand_in_ports     problems with                      those of ended
                                               nodes outside                      nodes go
    COUNT_TICK, while the   message_counter    what nodes count   topic_growth    added to the
    metrics are read                                                              metrics
    RETRY_BLOCKED           leases             ports that others                  they open
                                               had
    POST /containers        containers         the nodes there    liveness        unregistered,
                                                                                  moved, adopted
    a node registers that   adopter            the node, the      adoption        registered
    did around the proxy                       master                             anew
    what is hidden changes  publisher_updates  the registry                       they are told
                                                                                  again
"""
