"""Training: objectives, steps, checkpoints."""
