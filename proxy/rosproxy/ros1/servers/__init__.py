"""What the proxy serves: the master API inside, slave APIs and TCPROS on leased ports."""
