"""Training and evaluation of motion models."""
