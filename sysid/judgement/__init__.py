"""What is said of an estimate: explanations of what the model leaves, on one scale."""
