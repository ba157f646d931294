"""Elimination of landmarks, postures and people from the normal equations.

`solver/linear_system.py` has the order in which they are eliminated.
"""
