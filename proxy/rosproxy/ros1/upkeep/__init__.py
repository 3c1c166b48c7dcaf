"""What the proxy does at intervals or after an event, rather than because a node called.

Data flows one way. A client reads the answer of the master or of a node. A module of `decisions`
(pure: data and time in, data out) says what follows. Then the `Registrar` calls the master, or a
port opens or refuses connections.

    when                    module             reads              decided by      result
    ----------------------  -----------------  -----------------  --------------  --------------
    first answer of the     recovery           the master's       recovery_       leases as before
    master                                     graph, the nodes   claims
    --master-interval       master_monitor     the master's pid                   the next row
    new pid, or every       registrar          the master's       registration    lost
    fifth look                                 graph                              registrations
                                                                                  made again
    PROBE_CHECK_INTERVAL_S  prober             the node's pid     liveness        ports refuse,
    and --probe-interval                                                          nodes and leases
                                                                                  end
    RESUBSCRIBE_INTERVAL_S  resubscriber       the graph, the     resubscription  publisherUpdate
    and after an outage                        nodes'                             to subscribers
                                               connections                        without
                                                                                  connection
    ENFORCE_INTERVAL_S and  policy_enforcer    the registry,      Ros1Policy      registrations
    a changed policy                           connections                        hidden or shown,
                                                                                  connections cut
    TIDY_INTERVAL_S         stand_in_ports     problems with                      problems of ended
                                               nodes outside                      nodes removed
    COUNT_INTERVAL_S, if    message_counter    the nodes' counts  topic_growth    sums in the
    the metrics are read                                                          metrics
    RETRY_BLOCKED_S         leases             ports that other                   ports open
                                               programs held
    POST /containers        containers         the nodes there    liveness        nodes
                                                                                  unregistered,
                                                                                  moved, adopted
    a node registers that   adopter            the node, the      adoption        node registered
    registered directly                        master                             anew
    before
    hidden registrations    publisher_updates  the registry                       publisherUpdate
    change
"""
