"""Tables: text, sheets and columns, from bytes to channels."""
