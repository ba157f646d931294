"""Simulates scenes, exact or with noise, for tests, demo, notebooks and benchmarks."""

from bodyslam_jax.config import Simulation as Simulation
from bodyslam_jax.simulation.exact_scene import Scene as Scene
from bodyslam_jax.simulation.exact_scene import look_at as look_at
from bodyslam_jax.simulation.exact_scene import scene as scene
from bodyslam_jax.simulation.exact_scene import walk as walk
from bodyslam_jax.simulation.renderer import render as render
from bodyslam_jax.simulation.sequences import LENGTH as LENGTH
from bodyslam_jax.simulation.sequences import OTHER as OTHER
from bodyslam_jax.simulation.sequences import RECORDINGS as RECORDINGS
from bodyslam_jax.simulation.sequences import SimulatedSequence as SimulatedSequence
from bodyslam_jax.simulation.sequences import as_sequence as as_sequence
from bodyslam_jax.simulation.sequences import as_truth as as_truth
from bodyslam_jax.simulation.sequences import filmed_from as filmed_from
from bodyslam_jax.simulation.sequences import motion_file as motion_file
from bodyslam_jax.simulation.sequences import simulate as simulate
from bodyslam_jax.simulation.writing import check_folder as check_folder
from bodyslam_jax.simulation.writing import demo_scene as demo_scene
from bodyslam_jax.simulation.writing import demo_settings as demo_settings
from bodyslam_jax.simulation.writing import film_scene as film_scene
from bodyslam_jax.simulation.writing import write_sequence as write_sequence
