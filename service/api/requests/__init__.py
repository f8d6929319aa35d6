"""What holds for every request and answer: caller, limits, errors, log."""
