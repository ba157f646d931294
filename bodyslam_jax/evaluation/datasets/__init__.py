"""Converts public data sets to sequence folders with ground truth.

Layouts are as their authors document them: EMDB (Kaufmann et al., ICCV 2023), 3DPW (von
Marcard et al., ECCV 2018), RICH (Huang et al., CVPR 2022), and pairs of a TUM
trajectory and an AMASS file. Everything is read and checked before anything is written.
True joints are those of the gendered body that a data set was made with. Images are
linked, not copied. Pickles are read by the restricted reader only.
"""

from bodyslam_jax.evaluation.datasets.emdb import convert_emdb as convert_emdb
from bodyslam_jax.evaluation.datasets.gender import read_truth as read_truth
from bodyslam_jax.evaluation.datasets.rich import convert_rich as convert_rich
from bodyslam_jax.evaluation.datasets.threedpw import convert_3dpw as convert_3dpw
from bodyslam_jax.evaluation.datasets.tum_amass import (
    convert_tum_amass as convert_tum_amass,
)
