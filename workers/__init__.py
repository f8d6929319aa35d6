"""Where and when islands run: Ray."""
