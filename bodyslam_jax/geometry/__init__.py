"""Camera models, rotations, triangulation, planes and smoothing, for all stages."""
