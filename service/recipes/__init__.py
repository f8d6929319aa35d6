"""Recipes: jobs that are made for one purpose from the same pieces as any other."""
