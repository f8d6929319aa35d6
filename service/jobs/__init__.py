"""Submit, check and expand a job; warm-start order."""
