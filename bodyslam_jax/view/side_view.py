"""The inset below the plan: camera and people from the side, on the ground."""

import cv2
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.body.skeleton import head_ball
from bodyslam_jax.types import Result
from bodyslam_jax.view.person_style import person_styles
from bodyslam_jax.view.style import CAMERA, Image, blend_inset, polylines

_MAX_SPAN_M = 8.0
"""Width of the inset in the world, m; where the paths are longer, it moves along with
people."""
_LIMBS = (
    (15, 12, 9, 6, 3, 0),
    (0, 1, 4, 7, 10),
    (0, 2, 5, 8, 11),
    (22, 20, 18, 16, 13, 9, 14, 17, 19, 21, 23),
)


class SideView:
    """The scene from the side, across the horizontal direction in which paths are
    longest."""

    def __init__(self, result: Result, width: int):
        """The inset is `width` wide, px."""
        self.result, self.width = result, width
        self.styles = person_styles(result)
        places = [result.T_WC[result.located, :3, 3]]
        joints = result.joints[result.present]
        places.append(joints.reshape(-1, 3))
        every = np.concatenate(places)
        level = every[:, [0, 2]] - every[:, [0, 2]].mean(axis=0)
        self.along = np.zeros(3)
        self.along[[0, 2]] = np.linalg.svd(level.T @ level)[0][:, 0]
        # To the right is where the first person, else the camera, goes.
        ways = [*(j[p, 0] for j, p in zip(result.joints, result.present) if p.any())]
        way = (ways or [result.T_WC[:, :3, 3]])[0]
        if (way[-1] - way[0]) @ self.along < 0:
            self.along = -self.along
        way = every @ self.along
        self.centre = (way.min() + way.max()) / 2
        extent = max(1.15 * (way.max() - way.min()), 3.0)
        self.moves = extent > _MAX_SPAN_M
        self.zoom = width / min(extent, _MAX_SPAN_M)
        self.low = min(0.0, float(every[:, 1].min()))
        middle, radius = head_ball(joints)
        top = np.append(every[:, 1], middle[:, 1] + radius).max()
        high = max(2.1, float(top) + 0.05)
        self.height = int(np.clip(self.zoom * (high - self.low) + 8, 24, width))

    def draw(self, image: Image, frame: int, corner: tuple[int, int]) -> None:
        """Puts the inset into the image, its upper left corner at `corner`, px."""
        r = self.result
        there = np.flatnonzero(r.present[:, frame])
        eye = r.T_WC[frame, :3, 3]
        centre = self.centre
        if self.moves:
            centre = float(
                np.mean([eye @ self.along, *(r.joints[there, frame, 0] @ self.along)])
            )
        inset = np.full((self.height, self.width, 3), 28, np.uint8)
        at = lambda points: self._to_inset(points, centre)
        reach = self.width / self.zoom / 2
        for metre in np.arange(np.ceil(centre - reach), centre + reach):
            post = [metre * self.along, metre * self.along + [0, 9.0, 0]]
            cv2.polylines(inset, [at(np.array(post))], False, (52, 52, 52), 1, 8, 4)
        floor = np.array([centre - reach, centre + reach])[:, None] * self.along
        cv2.polylines(inset, [at(floor)], False, (150, 150, 150), 1, 8, 4)
        for h in there:
            limbs = [at(r.joints[h, frame, list(limb)]) for limb in _LIMBS]
            style = self.styles[h]
            for limb in limbs:
                polylines(inset, limb, style.faint, 2, style.dash and (4, 4))
            middle, radius = head_ball(r.joints[h, frame])
            round_head = 16 * max(round(float(radius) * self.zoom), 2)
            place = at(middle[None])[0].tolist()
            cv2.circle(inset, place, round_head, style.faint, -1, cv2.LINE_AA, 4)
        if r.located[frame]:
            right, down, ahead = r.T_WC[frame, :3, :3].T
            size = 14 / self.zoom
            tips = eye + size * np.array(
                [0 * ahead, ahead - 0.5 * down, ahead + 0.5 * down]
            )
            cv2.polylines(inset, [at(tips)], True, CAMERA, 2, cv2.LINE_AA, 4)
        blend_inset(image, inset, corner)

    def _to_inset(
        self, p: Float[np.ndarray, "n 3"], centre: float
    ) -> Int[np.ndarray, "n 2"]:
        u = self.width / 2 + self.zoom * (p @ self.along - centre)
        v = self.height - 5 - self.zoom * (p[:, 1] - self.low)
        uv = np.clip(np.stack([u, v], axis=-1), -2000, 4000)
        return np.round(uv * 16).astype(np.int32)
