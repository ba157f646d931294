"""Gravity, the ground and stances: what tells which way is up, and where feet stand."""
