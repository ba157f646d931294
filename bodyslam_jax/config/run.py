"""Settings of a whole run: one class per stage."""

import dataclasses
from typing import Literal

from bodyslam_jax.config.check import check
from bodyslam_jax.config.front_end import Association, Detect, Structure, Tracking
from bodyslam_jax.config.known import RANGES, Known
from bodyslam_jax.config.people import PeopleFit
from bodyslam_jax.config.weights import GraphWeights


@dataclasses.dataclass(frozen=True)
class Config(Known):
    """Settings of a whole run, one class per stage."""

    body_model: str | None = None
    """Body model file or folder; without it the default body or the one found."""
    motion_model: str | None = None
    """Motion model's weights: a file, or `paper` for the paper's network, which ships
    too; without it the default one."""
    people: bool = True
    """Whether people are estimated; if not, cameras and map stay without a unit."""
    detect: Literal["auto", "built-in", "yolox", "none"] = "auto"
    """Which networks find people in the images where no keypoints are given: those that
    ship (also `auto`), YOLOX and RTMPose, which are fetched once, or none."""
    offline: bool = False
    """Whether the network is never used: models must be there already."""
    device: Literal["cpu", "gpu"] | None = None
    """Where it is computed; without it where JAX finds best, a GPU if there is one."""
    overlay: bool = True
    """Whether `overlay.webm` is written."""
    uncertainty: bool = True
    """Whether standard deviations, and what is not determined, are worked out."""
    detection: Detect = Detect()
    association: Association = Association()
    tracking: Tracking = Tracking()
    structure: Structure = Structure()
    people_fit: PeopleFit = PeopleFit()
    weights: GraphWeights = GraphWeights()
    solver: Literal["structured", "adam", "optimistix_lm", "jaxopt_lm"] = "structured"
    """Second order with the problem's structure; the paper's 200 + 100 first-order
    steps; or dense Levenberg-Marquardt of optimistix or jaxopt, for small problems."""
    motion_coupling: Literal["frozen", "refreshed"] = "refreshed"
    """When motion is predicted: once, before the joint solve, or again after each
    accepted step. No derivative of the prediction enters the solve."""
    smoothing_hz: float | None = 6.0
    """People's motion faster than this is taken for noise in the result, Hz; nothing
    is smoothed without it."""

    def __post_init__(self):
        check(self, RANGES)
        self.check_known()

    @classmethod
    def paper(cls) -> "Config":
        """Section 3.6 of the paper: its weights, its motion network of section 3.4,
        whose predictions are measurements that stay as they are, and its first-order
        schedule. docs/differences_from_the_paper.md says what differs all the same."""
        return cls(
            motion_model="paper",
            motion_coupling="frozen",
            weights=GraphWeights.paper(),
            people_fit=PeopleFit(regressor_shape_gain=1.0),
            solver="adam",
            smoothing_hz=None,
        )
