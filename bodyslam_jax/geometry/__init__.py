"""Camera models, rotations, triangulation and smoothing, for all stages."""
