"""The web application, its server, commands and jobs for tests of the service."""
