"""Keypoint files of any common detector, read as people in BODY_25 order."""
