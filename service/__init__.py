"""REST, pages, command line, storage and dispatch."""
