"""How a motion model is trained and judged."""
