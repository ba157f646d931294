"""A room as boxes: walls, floor, ceiling and furniture, and what hides what.

World: y up, floor at y = 0, metres.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

_CLEARANCE = 0.35
"""Free space that furniture leaves around people and camera, m."""


@dataclasses.dataclass(frozen=True)
class Room:
    """The inside of a box, with `n` boxes in it."""

    low: Float[np.ndarray, "3"]
    """Corner of the room, m."""
    high: Float[np.ndarray, "3"]
    box_low: Float[np.ndarray, "n 3"]
    """Corners of the furniture, m."""
    box_high: Float[np.ndarray, "n 3"]


@dataclasses.dataclass(frozen=True)
class Surface:
    """A rectangle `origin + a edge_u + b edge_v`, a and b from 0 to 1."""

    origin: Float[np.ndarray, "3"]
    edge_u: Float[np.ndarray, "3"]
    edge_v: Float[np.ndarray, "3"]
    """Along the texture's rows, downwards on walls, m."""
    normal: Float[np.ndarray, "3"]
    """Unit vector to the side from which it is seen."""
    kind: str
    """`floor`, `ceiling`, `wall` or `furniture`."""


def make_room(
    rng: np.random.Generator,
    person: Float[np.ndarray, "t 3"],
    camera: Float[np.ndarray, "t 3"],
    margin: tuple[float, float] = (1.2, 2.5),
) -> Room:
    """A room around the two paths, whose furniture is in nobody's way or view.

    `margin` is how far walls are from the paths at least and at most, m.
    """
    both = np.concatenate([person, camera])
    low, high = both.min(axis=0), both.max(axis=0)
    low, high = low - rng.uniform(*margin, 3), high + rng.uniform(*margin, 3)
    low[1], high[1] = 0.0, max(rng.uniform(2.6, 3.2), camera[:, 1].max() + 0.4)
    boxes_low: list[np.ndarray] = []
    boxes_high: list[np.ndarray] = []
    wanted = int(np.clip(0.16 * (high - low)[[0, 2]].prod(), 6, 30))
    every = slice(None, None, 3)
    ways = np.concatenate([person[every], camera[every]])[:, [0, 2]]
    views = np.linspace(camera[every], person[every], 9).reshape(-1, 3)[:, [0, 2]]
    for _ in range(40 * wanted):
        if len(boxes_low) >= wanted:
            break
        size = rng.uniform((0.3, 0.3, 0.3), (1.3, 2.0, 1.3))
        size[1] *= rng.uniform(0.4, 1.0)
        at = rng.uniform(low[[0, 2]], high[[0, 2]] - size[[0, 2]])
        wall = rng.integers(0, 6)
        if wall < 4:  # Two thirds of all furniture stands at a wall.
            ends = (low, high - size)
            at[wall // 2] = ends[wall % 2][2 * (wall // 2)]
        a = np.array([at[0], 0.0, at[1]])
        b = a + size
        gap = lambda p: np.maximum(a[[0, 2]] - p, p - b[[0, 2]]).max(axis=1)
        if gap(ways).min() < _CLEARANCE or gap(views).min() < 0.1:
            continue
        if any(
            (a < h + 0.05).all() and (b > l - 0.05).all()
            for l, h in zip(boxes_low, boxes_high, strict=True)
        ):
            continue
        boxes_low.append(a)
        boxes_high.append(b)
    return Room(
        low,
        high,
        np.array(boxes_low).reshape(-1, 3),
        np.array(boxes_high).reshape(-1, 3),
    )


def surfaces(room: Room) -> list[Surface]:
    """All rectangles that can be seen from inside the room."""
    kinds = {(1, 0): "floor", (1, 1): "ceiling"}
    found = [
        _face(room.low, room.high, axis, side, -1.0, kinds.get((axis, side), "wall"))
        for axis in range(3)
        for side in range(2)
    ]
    for low, high in zip(room.box_low, room.box_high, strict=True):
        found += [
            _face(low, high, axis, side, 1.0, "furniture")
            for axis in range(3)
            for side in range(2)
            if (axis, side) != (1, 0)  # furniture stands on the floor
        ]
    return found


def _face(
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    axis: int,
    side: int,
    outward: float,
    kind: str,
) -> Surface:
    """One side of a box; the image on a wall is upright."""
    size = high - low
    origin = low.copy()
    origin[axis] = (low, high)[side][axis]
    u_axis, v_axis = {0: (2, 1), 1: (0, 2), 2: (0, 1)}[axis]
    edge_u, edge_v, normal = np.zeros(3), np.zeros(3), np.zeros(3)
    edge_u[u_axis], edge_v[v_axis] = size[u_axis], size[v_axis]
    if v_axis == 1:
        origin[1], edge_v = high[1], -edge_v
    normal[axis] = outward * (2 * side - 1)
    return Surface(origin, edge_u, edge_v, normal, kind)


def sample_points(
    rng: np.random.Generator, room: Room, count: int
) -> tuple[Float[np.ndarray, "l 3"], Float[np.ndarray, "l 3"]]:
    """Points on all surfaces and the normals there; furniture has twice its share."""
    faces = surfaces(room)
    area = np.array(
        [
            np.linalg.norm(f.edge_u)
            * np.linalg.norm(f.edge_v)
            * (2.0 if f.kind == "furniture" else 1.0)
            for f in faces
        ]
    )
    of = np.searchsorted(np.cumsum(area) / area.sum(), rng.random(count))
    of = np.minimum(of, len(faces) - 1)
    a, b = rng.uniform(0.01, 0.99, (2, count, 1))
    stack = lambda name: np.stack([getattr(f, name) for f in faces])[of]
    points = stack("origin") + a * stack("edge_u") + b * stack("edge_v")
    free = ~_inside(room, points)
    return points[free], stack("normal")[free]


def _inside(room: Room, points: Float[np.ndarray, "l 3"]) -> Bool[np.ndarray, " l"]:
    """Whether points of wall or floor are covered by furniture."""
    eps = 1e-6
    above = points[:, None] >= room.box_low - eps
    below = points[:, None] <= room.box_high + eps
    touching = (above & below).all(axis=2)
    # A point on a box touches that box; it is covered if it lies on the room's
    # boundary too.
    edge = (np.abs(points - room.low) < eps) | (np.abs(points - room.high) < eps)
    return touching.any(axis=1) & edge.any(axis=1)


def is_visible(
    room: Room, eye: Float[np.ndarray, "3"], points: Float[np.ndarray, "l 3"]
) -> Bool[np.ndarray, " l"]:
    """Whether no furniture is between `eye` and each point (slab test)."""
    if not len(room.box_low):
        return np.ones(len(points), bool)
    way = points - eye
    way = np.where(np.abs(way) < 1e-9, 1e-9, way)[:, None]
    first = (room.box_low - eye) / way
    second = (room.box_high - eye) / way
    enter = np.minimum(first, second).max(axis=2)
    leave = np.maximum(first, second).min(axis=2)
    hidden = (enter < leave) & (enter < 1 - 1e-4) & (leave > 1e-6)
    return ~hidden.any(axis=1)


def texture_size(surface: Surface, per_metre: float) -> Int[np.ndarray, "2"]:
    """Height and width of a surface's texture at `per_metre` texels a metre."""
    edges = np.linalg.norm([surface.edge_v, surface.edge_u], axis=1)
    return np.maximum(np.round(per_metre * edges), 8).astype(np.int64)
