"""Files as lagid and other programs write them."""
