"""Forms: their choices, proposed bounds, and the bodies that they become."""
