"""Motion capture: clips, their readers, and their retargeting to the body model."""
