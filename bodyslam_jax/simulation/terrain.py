"""Floors that are not level: faces of the room and paths of walkers that follow
them."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.simulation.gait_synthesis import Soles, Walk
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import Room, Surface

Height = Callable[[Float[np.ndarray, "*n 2"]], Float[np.ndarray, "*n"]]
"""Maps (x, z) to the height of the floor, m."""

TILE_LENGTH_M = 0.35
"""Length of the tiles that make up a floor, and of a step of stairs."""
_UP = np.array([0.0, 1.0, 0.0])


@dataclasses.dataclass(frozen=True)
class Terrain(Room):
    """A room whose floor height depends on the place."""

    height: Height

    def faces(self) -> tuple[Surface, ...]:
        """Returns all rectangles that can be seen: tiles of the floor, furniture raised
        to it, and the walls above it."""
        raised = [
            dataclasses.replace(
                box, centre=box.centre + self.height(box.centre[[0, 2]]) * _UP
            )
            for box in self.boxes
        ]
        whole = Room(self.walls, tuple(raised)).faces()
        walls = [strip for face in whole for strip in self._strips(face)]
        others = [face for face in whole if face.kind not in ("wall", "floor")]
        return (*others, *walls, *self._tiles())

    def _strips(self, wall: Surface) -> Iterator[Surface]:
        """Yields the part of a wall that is above the floor, as strips."""
        if wall.kind != "wall":
            return
        count = int(np.ceil(np.linalg.norm(wall.edge_u) / TILE_LENGTH_M))
        for k in range(count):
            origin, u = wall.origin + k / count * wall.edge_u, wall.edge_u / count
            foot = self.height((origin + u / 2)[[0, 2]])
            yield dataclasses.replace(
                wall, origin=origin, edge_u=u, edge_v=-(origin[1] - foot) * _UP
            )

    def _tiles(self) -> Iterator[Surface]:
        """Yields the tiles of the floor."""
        low, high = (self.walls.centre + s * self.walls.half for s in (-1, 1))
        at = [
            TILE_LENGTH_M
            * np.arange(np.floor(low[i] / TILE_LENGTH_M), high[i] / TILE_LENGTH_M)
            for i in (0, 2)
        ]
        corners = np.stack(np.meshgrid(*at, indexing="ij"), axis=-1).reshape(-1, 2)
        middle = corners + TILE_LENGTH_M / 2
        slope = [
            (self.height(middle + d) - self.height(middle - d)) / 0.02
            for d in 0.01 * np.eye(2)
        ]
        for (x, z), y, a, b in zip(middle, self.height(middle), *slope, strict=True):
            u, v = (
                TILE_LENGTH_M * np.array([1.0, a, 0.0]),
                TILE_LENGTH_M * np.array([0.0, b, 1.0]),
            )
            normal = np.array([-a, 1.0, -b]) / np.sqrt(1 + a * a + b * b)
            origin = np.array([x, y, z]) - u / 2 - v / 2
            yield Surface(origin, u, v, normal, "floor")


def lifted(person: Person, walk: Walk, height: Height, drift: float = 0.0) -> Walk:
    """Returns the walk with the supporting foot on the floor.

    With a `drift`, m, the walker rises and sinks by that much over the floor, as
    recorded motion does.
    """
    soles = Soles(person)(walk.poses, walk.pelvis)
    share = np.exp(-(soles[..., 1] - soles[..., 1].min(axis=1, keepdims=True)) / 0.01)
    share /= share.sum(axis=1, keepdims=True)
    lift = gaussian_filter1d((share * height(soles[..., [0, 2]])).sum(axis=1), 2.0)
    t = len(lift)
    lift = lift + drift * (1 - np.cos(1.6 * np.pi * np.arange(t) / t)) / 2
    return Walk(walk.poses, walk.pelvis + lift[:, None] * [0, 1, 0])
