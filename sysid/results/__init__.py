"""Result of an identification: estimates, verdict, bands, figures; shown, saved and loaded."""
