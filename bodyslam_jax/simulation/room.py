"""A room of boxes: walls, floor, ceiling and furniture, with occlusion tests.

World: y up, floor at y = 0, metres; `Terrain` has floors that are not level, with the
paths of walkers that follow them.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.simulation.gait_synthesis import Soles, Walk
from bodyslam_jax.simulation.posing import Person

_CLEARANCE_M = 0.35
"""Free space that furniture leaves around people and camera."""
_CUPBOARD_HALF_SIZES_M = ((0.25, 0.3, 0.2), (0.5, 0.42, 0.3))
_PILLAR_HALF_SIZES_M = ((0.12, 0.9, 0.12), (0.25, 1.1, 0.25))
"""Half of the least and of the largest width, height and depth of cupboards and
pillars."""
Height = Callable[[Float[np.ndarray, "*n 2"]], Float[np.ndarray, "*n"]]
"""Maps (x, z) to the height of the floor, m."""
TILE_LENGTH_M = 0.35
"""Length of the tiles that make up a floor, and of a step of stairs."""
_UP = np.array([0.0, 1.0, 0.0])
TEXELS_PER_METRE = 130.0
"""Resolution of textures: a camera of 525 px sees texels at a scale of 1 from 4 m."""
_MAX_HIDDEN_SHARE = 0.35
"""Share of the time for which occluding objects may hide the first person's feet."""


@dataclasses.dataclass(frozen=True)
class Surface:
    """A rectangle `origin + a edge_u + b edge_v`, a and b from 0 to 1."""

    origin: Float[np.ndarray, "3"]
    edge_u: Float[np.ndarray, "3"]
    edge_v: Float[np.ndarray, "3"]
    """Edge along the texture's columns, downwards on walls, m."""
    normal: Float[np.ndarray, "3"]
    """Unit vector to the visible side."""
    kind: str
    """`floor`, `ceiling`, `wall` or `furniture`."""


@dataclasses.dataclass(frozen=True)
class Box:
    """A box that is rotated about the vertical only."""

    centre: Float[np.ndarray, "3"]
    half: Float[np.ndarray, "3"]
    """Half of its width, height and depth, m."""
    yaw: float
    """Rotation about the vertical, rad."""

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Directions of its width, height and depth in the world, as columns."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def side(self, axis: int, sign: int, inwards: bool, kind: str) -> Surface:
        """Returns the face whose outer normal is `sign` times direction `axis`."""
        u, v = {0: (2, 1), 1: (0, 2), 2: (0, 1)}[axis]
        axes = self.axes
        edges = 2 * self.half * axes
        corner = self.centre + sign * self.half[axis] * axes[:, axis]
        down = -1.0 if v == 1 else 1.0
        origin = corner - edges[:, u] / 2 - down * edges[:, v] / 2
        normal = (-sign if inwards else sign) * axes[:, axis]
        return Surface(origin, edges[:, u], down * edges[:, v], normal, kind)


@dataclasses.dataclass(frozen=True)
class Room:
    """The inside of a box, with boxes that stand on its floor."""

    walls: Box
    boxes: tuple[Box, ...]

    def faces(self) -> tuple[Surface, ...]:
        """Returns all rectangles that can be seen from inside."""
        kinds = {(1, -1): "floor", (1, 1): "ceiling"}
        room = [
            self.walls.side(axis, sign, True, kinds.get((axis, sign), "wall"))
            for axis in range(3)
            for sign in (-1, 1)
        ]
        furniture = [
            box.side(axis, sign, False, "furniture")
            for box in self.boxes
            for axis in range(3)
            for sign in (-1, 1)
            if (axis, sign) != (1, -1)  # bottoms are hidden
        ]
        return (*room, *furniture)

    def is_hidden(
        self, eye: Float[np.ndarray, "3"], points: Float[np.ndarray, "l 3"]
    ) -> Bool[np.ndarray, " l"]:
        """Returns whether furniture is between `eye` and each point (slab test)."""
        hidden = np.zeros(len(points), bool)
        if not len(points):
            return hidden
        low = np.minimum(points.min(axis=0), eye)
        high = np.maximum(points.max(axis=0), eye)
        for box in self.boxes:
            reach = np.linalg.norm(box.half)
            if (box.centre + reach < low).any() or (box.centre - reach > high).any():
                continue
            start = (eye - box.centre) @ box.axes
            way = (points - eye) @ box.axes
            way = np.where(np.abs(way) < 1e-9, 1e-9, way)
            first, second = (-box.half - start) / way, (box.half - start) / way
            enter = np.minimum(first, second).max(axis=1)
            leave = np.maximum(first, second).min(axis=1)
            hidden |= (enter < leave) & (enter < 1 - 1e-4) & (leave > 1e-6)
        return hidden


def furnish(
    person: Float[np.ndarray, "t 3"],
    camera: Float[np.ndarray, "t 3"],
    rng: np.random.Generator,
    *,
    is_hall: bool = False,
) -> Room:
    """Returns a room around two paths, whose furniture neither blocks nor occludes
    anybody.

    Walls are 1.2 to 2.5 m from the paths; a hall is higher and has more furniture in
    its middle.
    """
    both = np.concatenate([person, camera])
    low = both.min(axis=0) - rng.uniform(1.2, 2.5, 3)
    high = both.max(axis=0) + rng.uniform(1.2, 2.5, 3)
    height = rng.uniform(3.5, 5.0) if is_hall else rng.uniform(2.6, 3.2)
    low[1], high[1] = 0.0, max(height, both[:, 1].max() + 0.4)
    walls = Box((low + high) / 2, (high - low) / 2, 0.0)
    wanted = int(np.clip(0.14 * (high - low)[[0, 2]].prod(), 6, 40))
    ways = both[::3, [0, 2]]
    views = np.linspace(camera[::3], person[::3], 9).reshape(-1, 3)[:, [0, 2]]
    boxes: list[Box] = []
    for _ in range(40 * wanted):
        if len(boxes) >= wanted:
            break
        half = 0.5 * rng.uniform((0.3, 0.3, 0.3), (1.3, 1.9, 1.3))
        at = rng.uniform(low + half, high - half)
        yaw = rng.uniform(0, np.pi)
        wall = int(rng.integers(0, 4 if is_hall else 6))
        if wall < (2 if is_hall else 4):  # Most furniture stands at a wall.
            yaw, axis = 0.0, 2 * (wall // 2) if not is_hall else 2 * wall
            side = rng.integers(0, 2)
            at[axis] = ((low + half), (high - half))[side][axis]
        at[1] = half[1]
        box = Box(at, half, yaw)
        if _gap(box, ways) < _CLEARANCE_M or _gap(box, views) < 0.1:
            continue
        radius = np.hypot(half[0], half[2])
        to_wall = np.minimum(at - low, high - at)[[0, 2]].min()
        if yaw and to_wall < radius:
            continue
        if all(_apart(box, other) for other in boxes):
            boxes.append(box)
    return Room(walls, tuple(boxes))


def put_in_the_way(
    room: Room,
    people: Sequence[Float[np.ndarray, "t 3"]],
    camera: Float[np.ndarray, "t 3"],
    rng: np.random.Generator,
) -> Room:
    """Returns the room with up to three more objects that occlude people temporarily.

    They are low cupboards, which occlude legs, and pillars. They stand between the
    camera and the first person, off both paths, and occlude that person's feet for a
    share of at most `_MAX_HIDDEN_SHARE` of the time.
    """
    ways = np.concatenate([*people, camera])[::3, [0, 2]]
    pelvis = people[0]
    placed = 0
    for _ in range(400):
        k = int(rng.integers(len(camera)))
        at = camera[k] + rng.uniform(0.4, 0.85) * (pelvis[k] - camera[k])
        low, high = (
            _CUPBOARD_HALF_SIZES_M if rng.random() < 0.6 else _PILLAR_HALF_SIZES_M
        )
        half = rng.uniform(low, high)
        at[1] = half[1]
        box = Box(at, half, rng.uniform(0, np.pi))
        if _gap(box, ways) < _CLEARANCE_M or not all(
            _apart(box, b) for b in room.boxes
        ):
            continue
        more = Room(room.walls, (*room.boxes, box))
        feet = pelvis[::3] * [1, 0, 1] + [0, 0.1, 0]
        hidden = [
            more.is_hidden(c, p[None])[0]
            for c, p in zip(camera[::3], feet, strict=True)
        ]
        if np.mean(hidden) > _MAX_HIDDEN_SHARE:
            continue
        room, placed = more, placed + 1
        if placed == 3:
            break
    return room


def _gap(box: Box, points: Float[np.ndarray, "l 2"]) -> float:
    """Returns the smallest distance on the floor from a box to points, along its own
    axes, m."""
    c, s = np.cos(box.yaw), np.sin(box.yaw)
    local = (points - box.centre[[0, 2]]) @ np.array([[c, s], [-s, c]])
    return float((np.abs(local) - box.half[[0, 2]]).max(axis=1).min())


def _apart(a: Box, b: Box) -> bool:
    """Returns whether two boxes are certain not to touch, by their circumscribed
    circles on the floor or by their sides."""
    way = np.abs(a.centre - b.centre)[[0, 2]]
    if a.yaw == b.yaw == 0.0:
        return bool((way > a.half[[0, 2]] + b.half[[0, 2]] + 0.03).any())
    reach = np.hypot(*a.half[[0, 2]]) + np.hypot(*b.half[[0, 2]])
    return bool(np.hypot(*way) > reach)


def landmarks_on(
    faces: tuple[Surface, ...], density: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "l 3"], Float[np.ndarray, "l 3"]]:
    """Returns points on all faces, `density` per square metre, and the normals there.

    Furniture, being nearer, has twice as many; the ceiling, being plain, half.
    """
    share = {"furniture": 2.0, "ceiling": 0.5}
    points, normals = [], []
    for face in faces:
        area = np.linalg.norm(face.edge_u) * np.linalg.norm(face.edge_v)
        count = rng.poisson(density * area * share.get(face.kind, 1.0))
        a, b = rng.uniform(0.01, 0.99, (2, count, 1))
        points.append(face.origin + a * face.edge_u + b * face.edge_v)
        normals.append(np.tile(face.normal, (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def texture_size(surface: Surface) -> Int[np.ndarray, "2"]:
    """Returns height and width of a surface's texture, texels."""
    edges = np.linalg.norm([surface.edge_v, surface.edge_u], axis=1)
    return np.maximum(np.round(TEXELS_PER_METRE * edges), 8).astype(np.int64)


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
