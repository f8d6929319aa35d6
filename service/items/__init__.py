"""What users do with a stored item of any kind: find, edit, delete."""
