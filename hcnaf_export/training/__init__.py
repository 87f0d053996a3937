"""Training: recipes in, run directories out."""
