"""Reports: one HTML file of a job, or of an identification of this process."""
