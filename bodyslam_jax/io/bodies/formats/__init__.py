"""Body formats: every `BodyFormat` in a module of this folder is read.

A new format is a subclass (`io/bodies/body_format.py`) in a file of its own.
"""
