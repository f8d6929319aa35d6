"""Which parameters the data tell apart: symmetries, null directions, active bounds."""
