"""HTTP client of the service. It loads neither NumPy nor Ray."""
