"""Elimination of landmarks, postures and people from the normal equations."""
