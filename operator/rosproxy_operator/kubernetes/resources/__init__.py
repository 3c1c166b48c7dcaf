"""The cluster's objects as the operator knows them: what the API server holds, read. Pure."""
