"""The estimate while the video runs: front end, fixed-lag window, result."""

from bodyslam_jax.online.estimate import Estimate as Estimate
from bodyslam_jax.online.estimate import PersonEstimate as PersonEstimate
from bodyslam_jax.online.online import Online as Online
