"""What speaks against an estimate: start, past, hold, step, order, suspects, validation."""
