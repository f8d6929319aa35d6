"""The documentation that a server shows, as pages and as notebooks."""
