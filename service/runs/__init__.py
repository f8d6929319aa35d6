"""A run read back: result, residuals, profiles, comparison, export, validation."""
