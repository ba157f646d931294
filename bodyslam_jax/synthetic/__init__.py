"""Exact and noisy made-up scenes, for tests, demo, notebooks and benchmarks."""

from bodyslam_jax.synthetic._scene import Scene as Scene
from bodyslam_jax.synthetic._scene import look_at as look_at
from bodyslam_jax.synthetic._scene import scene as scene
from bodyslam_jax.synthetic._scene import walk as walk
