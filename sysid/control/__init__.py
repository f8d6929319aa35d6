"""Controllers, linearisation, margins, tuning, closed loop."""
