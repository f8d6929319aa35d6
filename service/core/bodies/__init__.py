"""Bodies and answers: wire types, JSON, pointers, and the messages of faults."""
