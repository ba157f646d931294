"""Whether inputs agree with each other, and whether a result can be true."""
