"""The overlay video of bodies and map on the images, and single frames of it."""

from bodyslam_jax.view.overlay import can_write as can_write
from bodyslam_jax.view.overlay import write_overlay as write_overlay
from bodyslam_jax.view.people import coarse_body as coarse_body
from bodyslam_jax.view.people import draw_frame as draw_frame
