"""A run: video -> people -> tracks -> cameras -> bodies -> graph -> result."""

from bodyslam_jax.pipeline.people_stage import find_people as find_people
from bodyslam_jax.pipeline.run import before_joint as before_joint
from bodyslam_jax.pipeline.run import run as run
from bodyslam_jax.pipeline.run_folder import demo as demo
from bodyslam_jax.pipeline.run_folder import run_to_folder as run_to_folder
from bodyslam_jax.pipeline.stage_cache import Cache as Cache
