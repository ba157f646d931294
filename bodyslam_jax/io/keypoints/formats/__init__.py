"""Keypoint formats: every `KeypointFormat` in a module of this folder is read.

A new format is a subclass (`io/keypoints/keypoint_format.py`) in a file of its own.
"""
