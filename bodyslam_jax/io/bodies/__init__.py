"""Result files of the tools that regress bodies, read as bodies in the camera frame."""
