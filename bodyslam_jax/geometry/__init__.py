"""Cameras, rotations, planes and smoothing: what every stage computes with."""
