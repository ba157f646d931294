"""People of a running video: their keypoints, the mask of the map, and their bodies.

A body is filtered from frame to frame; the filter begins again at the solution of a
window.
"""

import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.online.window import Solved
from bodyslam_jax.people.filter import Body, PersonFilter
from bodyslam_jax.people.live import LivePeople
from bodyslam_jax.sfm.person_mask import draw_person
from bodyslam_jax.types import Intrinsics

_MASK_MARGIN = 0.06
"""Width of the mask around a person relative to the person's height, as offline."""
_MAX_UNSEEN_S = 0.5
"""Time without keypoints after which a person is not in the estimate, s."""
_MEAN_BETAS = np.zeros(10)
"""β of a person whom no window has solved."""


class LiveBodies:
    """People by their numbers, with their filters and the contacts of their feet."""

    def __init__(
        self, config: Config, body: BodyModel, fps: float, spared_cores: int
    ) -> None:
        self.config, self.body, self.fps = config, body, fps
        given = config.detection, config.association, spared_cores
        self.found = LivePeople(fps, *given)
        self.filters: dict[int, PersonFilter] = {}
        self.last_seen: dict[int, float] = {}
        self.contacts: dict[int, Float[np.ndarray, " 4"]] = {}
        """Contacts in the person's last frame of the last window."""

    def find(
        self,
        timestamp: float,
        image: UInt8[np.ndarray, "y x 3"] | None,
        keypoints: Float[np.ndarray, "p 25 3"] | None,
    ) -> dict[int, Float[np.ndarray, "25 3"]]:
        """Returns keypoints (u px, v px, confidence) in the next frame, by person:
        those given, or else those that the networks find."""
        if not self.config.people:
            return {}
        if keypoints is not None:
            return self.found.given(np.asarray(keypoints, float), timestamp, image)
        if image is None or self.config.detect == "none":
            return {}
        return self.found.find(image, timestamp)

    def mask(
        self, people: dict[int, np.ndarray], intrinsics: Intrinsics
    ) -> UInt8[np.ndarray, "y x"] | None:
        """Returns a mask that is not 0 where people are; `None` without people."""
        if not people:
            return None
        mask = np.zeros((intrinsics.height, intrinsics.width), np.uint8)
        for points in people.values():
            draw_person(mask, points, _MASK_MARGIN)
        return mask

    def follow(
        self,
        timestamp: float,
        people: dict[int, np.ndarray],
        intrinsics: Intrinsics,
        shapes: dict[int, np.ndarray],
    ) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Returns T_CH and θ of the people who were visible within the last half
        second; `shapes` are those that windows have solved."""
        found = {}
        for person in people:
            if person not in self.filters:
                self.filters[person] = PersonFilter(
                    intrinsics, self.body, self.fps, self.config.people_fit
                )
            self.last_seen[person] = timestamp
        for person, one in list(self.filters.items()):
            if timestamp - self.last_seen[person] > _MAX_UNSEEN_S:
                del self.filters[person]
                self.contacts.pop(person, None)
                continue
            points = people.get(person, np.zeros((25, 3)))
            body = one.update(timestamp, points, shapes.get(person, _MEAN_BETAS))
            if body is not None:
                found[person] = body.T_CH, body.body_pose
        return found

    def predict(self, timestamp: float) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Returns T_CH and θ, in a frame in which nobody was looked for, of the people
        who were visible within the last half second."""
        found = {}
        for person, one in self.filters.items():
            recent = timestamp - self.last_seen[person] <= _MAX_UNSEEN_S
            body = one.predicted(timestamp) if recent else None
            if body is not None:
                found[person] = body.T_CH, body.body_pose
        return found

    def learn(self, solved: Solved, shapes: dict[int, np.ndarray]) -> None:
        """Updates contacts and newest bodies from a window."""
        for h, person in enumerate(solved.people):
            if person is None or not solved.present[h].any():
                continue
            last = int(np.flatnonzero(solved.present[h])[-1])
            self.contacts[person] = solved.contacts[h, last]
            if person in self.filters:
                body = Body(solved.roots[h, last], solved.poses[h, last])
                at = float(solved.times[last])
                self.filters[person].anchor(at, body, shapes.get(person, _MEAN_BETAS))
