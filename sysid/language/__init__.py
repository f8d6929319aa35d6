"""The model language: grammar, checks, expression trees."""
