"""The live page: the graph of nodes and topics, with each problem at the broken node or link.

`feed` asks the proxy, the master and the nodes while a page is open. `judgement` holds the doctor's
findings, `measures` the counters of nodes and relays. From these, `graph_document` (ROS 1) and
`domain_graph` (ROS 2) make a document, with the rows and bounds of `page_document`. `changes` finds
the differences between two documents. `routes` serves documents, changes and the ``files``.
`visitors` decides which requests may see the page.
"""
