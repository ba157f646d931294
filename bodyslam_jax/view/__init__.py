"""Pictures of a result: the overlay video, single frames of it, the page in 3D."""

from bodyslam_jax.view.overlay import write_overlay as write_overlay
from bodyslam_jax.view.people import coarse_body as coarse_body
from bodyslam_jax.view.people import draw_frame as draw_frame
from bodyslam_jax.view.people import middle_frame as middle_frame
from bodyslam_jax.view.people import still as still
from bodyslam_jax.view.scene_data import NotebookScene as NotebookScene
from bodyslam_jax.view.scene_data import VideoSampler as VideoSampler
from bodyslam_jax.view.scene_data import VideoSamples as VideoSamples
from bodyslam_jax.view.scene_data import notebook_scene as notebook_scene
from bodyslam_jax.view.scene_data import read_runs as read_runs
from bodyslam_jax.view.scene_data import scene_data as scene_data
from bodyslam_jax.view.scene_data import scene_page as scene_page
from bodyslam_jax.view.scene_data import write_scene as write_scene
from bodyslam_jax.view.video_file import Codec as Codec
from bodyslam_jax.view.video_file import can_write as can_write
from bodyslam_jax.view.video_file import check_codec as check_codec
