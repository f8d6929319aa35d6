"""What speaks against an estimate: explanations of the data that are compared with it."""
