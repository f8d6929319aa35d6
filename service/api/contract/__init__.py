"""The contract of the interface: the OpenAPI document, its examples, and the files made of it."""
