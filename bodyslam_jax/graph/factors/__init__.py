"""The error terms of the graph, one kind of measurement a file."""
