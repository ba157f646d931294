"""Settings of a whole run: one class per stage."""

import dataclasses
from typing import Literal

from bodyslam_jax.config._check import check
from bodyslam_jax.config._front_end import Association, Detect, Structure, Tracking
from bodyslam_jax.config._people import PeopleFit
from bodyslam_jax.config._weights import GraphWeights


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of a whole run, one class per stage."""

    body_model: str | None = None
    """Body model file or folder; without it the default body or the one found."""
    motion_model: str | None = None
    """Motion model's weights; without them the ones that ship."""
    people: bool = True
    """Whether people are estimated; if not, cameras and map stay without a unit."""
    detect: Literal["auto", "built-in", "yolox", "none"] = "auto"
    """Which networks find people in the images where no keypoints are given: those that
    ship (also `auto`), YOLOX and RTMPose, which are fetched once, or none."""
    offline: bool = False
    """Whether the network is never used: models must be there already."""
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
    solver: Literal["structured", "adam"] = "structured"
    """Second order, or the paper's 200 + 100 first-order steps."""
    motion_coupling: Literal["frozen", "refreshed", "displacement", "full"] = (
        "refreshed"
    )
    """How predicted motion follows the estimate: made once; anew after each step; or
    with its derivative too, of displacements or of all that is predicted."""
    smoothing_hz: float | None = 6.0
    """People's motion faster than this is taken for noise in the result, Hz; nothing
    is smoothed without it."""

    def __post_init__(self):
        check(self)

    @classmethod
    def paper(cls) -> "Config":
        """Weights and schedule of section 3.6 of the paper."""
        return cls(
            weights=GraphWeights.paper(),
            people_fit=PeopleFit(regressor_shape_gain=1.0),
            solver="adam",
            smoothing_hz=None,
        )
