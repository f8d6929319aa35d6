"""Model documents of users."""
