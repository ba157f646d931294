"""What a person looks at: the overlay video, and single frames of it."""

from bodyslam_jax.view._people import coarse_body as coarse_body
from bodyslam_jax.view._people import draw_frame as draw_frame
from bodyslam_jax.view._video import can_write as can_write
from bodyslam_jax.view._video import write_overlay as write_overlay
