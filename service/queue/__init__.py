"""Leases, fencing, admission, reuse, wake-up, orphaned jobs."""
