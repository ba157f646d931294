"""Keypoint formats: every `KeypointFormat` in a module of this folder is read."""
