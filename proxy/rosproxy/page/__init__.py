"""The live page: the graph of nodes and topics, with what is wrong where it is wrong.

`measures` keeps what was counted, `graph` and `domain_graph` make of it and of what the doctor says
a document, `changes` tells what is new in one. `feed` asks for as long as somebody looks, `routes`
serves it with the ``files``, and `visitors` says who may look.
"""
