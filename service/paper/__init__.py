"""The paper's tables and figures as real jobs; used by its command alone."""
