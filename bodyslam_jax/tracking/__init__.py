"""Assigns detections to people from frame to frame, by place, size and clothes."""
