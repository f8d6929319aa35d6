"""The whole: search, best estimate, evidence; `identify()`, `Run`."""
