"""Camera calibrations, camera paths and trajectories that come as files."""
