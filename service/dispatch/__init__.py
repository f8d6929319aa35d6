"""What the dispatcher is made of: leases, preparation of runs, and their records."""
