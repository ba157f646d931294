"""Images -> tracks of static points, about 200 a frame, spread over the image.

BRISK detects the points; pyramidal Lucas--Kanade (KLT) tracks each from frame to frame,
forward and backward. BRISK descriptors recover points that were lost for a while.
Epipolar RANSAC over a gap of frames removes points that do not move with the scene;
people are masked.
"""

import dataclasses
from collections import deque
from collections.abc import Callable, Iterable

import cv2
import numpy as np
from jaxtyping import UInt8

from bodyslam_jax.config import Tracking
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.io.video import frames
from bodyslam_jax.sfm.burnt_in import still_limit
from bodyslam_jax.sfm.features import epipolar_inliers, make_brisk, match, spread
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Sequence, Tracks

_REFILL_GAP = 3
"""Frames between two searches for points, unless half of them are gone."""
_KEYFRAME_STEP = 12
"""Frames between two that are remembered."""
_NUM_KEYFRAMES = 12
_FEWEST_MOVING = 15
_TIMES_STILL = 4.0
"""Displacement of a point that moves, of that of one that may be still."""
_ROUND_TRIP = 0.5
"""Largest forward-backward error of KLT, px: assumes that KLT localises a window to
clearly better than that, in images of any size."""
_LEAST_CONTRAST = 6
"""BRISK's threshold in the flattest image, grey levels."""
_CONTRAST, _OCTAVES = 20, 3
"""BRISK's threshold at the start, grey levels, and octaves of its pyramid."""
CELLS = 8
"""Cells along the longer side of the image, over which points are spread."""
WINDOW = 21
"""Side of the window that Lucas--Kanade follows, px (OpenCV's default)."""
_EPIPOLAR_LIMIT = 1.5
"""Distance from the epipolar line beyond which a point is dropped, px: 3 σ of an
assumed tracking noise of 0.5 px at 640x480; not scaled with the image."""
_RIGID_GAP = 10
"""Frames over which points must fit one rigid motion."""
_PERSON_MARGIN = 0.06
"""Width that is masked around people's keypoints, of the person's height."""


Mask = UInt8[np.ndarray, "y x"]


def follow(
    sequence: Sequence,
    config: Tracking,
    *,
    hidden: Iterable[Mask] | None = None,
    look: Callable[[Mask], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Follows points through the images of a sequence, once.

    Args:
        hidden: a mask (255) for each frame, added to those of the people.
        look: called with each gray image.
        progress: called with the number of frames done and their total.

    **Raises:** `ValueError` if images cannot be read or OpenCV lacks BRISK.
    """
    tracker = _Tracker(sequence, config)
    images = frames(sequence, gray=True)
    masks = person_masks(sequence, _PERSON_MARGIN)
    if hidden is not None:
        masks = (
            other if mask is None else cv2.bitwise_or(mask, other)
            for mask, other in zip(masks, hidden, strict=False)
        )
    total = sequence.num_frames
    for k, (image, mask) in enumerate(zip(images, masks, strict=False)):
        tracker.advance(k, image, mask)
        if look is not None:
            look(image)
        if progress is not None:
            progress(k + 1, total)
    return tracker.tracks()


@dataclasses.dataclass
class _Live:
    """Points being followed; rows belong together."""

    ids: np.ndarray
    uv: np.ndarray
    step: np.ndarray
    """Last motion, px a frame: the start of the next search."""

    def keep(self, mask: np.ndarray) -> "_Live":
        return _Live(*(getattr(self, f.name)[mask] for f in dataclasses.fields(self)))

    def add(self, ids: np.ndarray, uv: np.ndarray) -> "_Live":
        return _Live(
            np.concatenate([self.ids, ids]),
            np.concatenate([self.uv, uv]),
            np.concatenate([self.step, np.zeros_like(uv)]),
        )


@dataclasses.dataclass(frozen=True)
class _Keyframe:
    """A frame whose points can be found again."""

    image: np.ndarray
    ids: np.ndarray
    uv: np.ndarray
    descriptors: np.ndarray


class _Tracker:
    """What is remembered from frame to frame; memory does not grow with images."""

    def __init__(self, sequence: Sequence, config: Tracking):
        self.config = config
        self.size = (sequence.intrinsics.width, sequence.intrinsics.height)
        self.K, self.distortion = as_opencv(sequence.intrinsics.params)
        self.brisk = make_brisk(_CONTRAST, _OCTAVES)
        self.live = _Live(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        self.previous: np.ndarray | None = None
        self.recent: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=_RIGID_GAP + 1)
        self.rows: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.next_id = 0
        self.threshold = _CONTRAST
        self.last_refill = -_REFILL_GAP
        self.keyframes: deque[_Keyframe] = deque(maxlen=_NUM_KEYFRAMES)
        self.last_keyframe = -_KEYFRAME_STEP
        self.scale_of: dict[int, float] = {}
        """Size of the BRISK keypoint that began a point, px."""

    def advance(self, k: int, gray: np.ndarray, mask: np.ndarray | None) -> None:
        if self.previous is not None and len(self.live.ids):
            self._follow(gray, mask)
            self._drop_moving()
        if self._is_sparse(k):
            self._refill(gray, mask)
            self.last_refill = k
            if k - self.last_keyframe >= _KEYFRAME_STEP:
                self._remember(gray)
                self.last_keyframe = k
        self.previous = gray
        self.recent.append((self.live.ids, self.live.uv))
        self.rows.append((k, self.live.ids, self.live.uv))

    def tracks(self) -> Tracks:
        """All observations of points seen three times (in all frames, if fewer)."""
        frame = np.concatenate([np.full(len(i), k) for k, i, _ in self.rows])
        ids = np.concatenate([i for _, i, _ in self.rows])
        uv = np.concatenate([u for _, _, u in self.rows])
        count = np.bincount(ids, minlength=self.next_id)
        kept = count[ids] >= min(3, len(self.rows))
        _, landmark = np.unique(ids[kept], return_inverse=True)
        return Tracks(frame[kept], landmark.astype(np.int64), uv[kept])

    def _follow(self, image: np.ndarray, mask: np.ndarray | None) -> None:
        """KLT from the previous image, with the forward-backward check."""
        assert self.previous is not None
        live = self.live
        guess = live.uv + live.step
        uv, ok = self._flow(self.previous, image, live.uv, guess)
        back, ok_back = self._flow(image, self.previous, uv, live.uv)
        ok &= ok_back & (np.linalg.norm(back - live.uv, axis=-1) < _ROUND_TRIP)
        ok &= self._inside(uv, mask)
        live.step, live.uv = uv - live.uv, uv
        self.live = live.keep(ok)

    def _flow(
        self,
        a: np.ndarray,
        b: np.ndarray,
        uv: np.ndarray,
        guess: np.ndarray,
        levels: int = 4,
    ) -> tuple[np.ndarray, np.ndarray]:
        found, ok, _ = cv2.calcOpticalFlowPyrLK(
            a,
            b,
            uv.astype(np.float32).reshape(-1, 1, 2),
            guess.astype(np.float32).reshape(-1, 1, 2),
            winSize=(WINDOW, WINDOW),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=1e-4,
        )
        return found.reshape(-1, 2).astype(np.float64), ok.ravel() > 0

    def _inside(self, uv: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        border = 4
        width, height = self.size
        x, y = uv.T
        ok = (
            (x >= border) & (y >= border) & (x < width - border) & (y < height - border)
        )
        if mask is not None:
            column = np.clip(np.round(x), 0, width - 1).astype(np.int64)
            row = np.clip(np.round(y), 0, height - 1).astype(np.int64)
            ok &= mask[row, column] == 0
        return ok

    def _drop_moving(self) -> None:
        """Drops what does not fit one rigid motion over the last frames."""
        live = self.live
        keep = np.ones(len(live.ids), dtype=bool)
        if not self.recent:
            return
        ids, uv = self.recent[0]
        _, now, then = np.intersect1d(live.ids, ids, return_indices=True)
        # What stays at its pixel fits every essential matrix without rotation: if it is
        # burnt into the image, what moves would be dropped in its stead.
        moved = np.linalg.norm(live.uv[now] - uv[then], axis=-1)
        moving = moved > _TIMES_STILL * still_limit(self.size)
        if _FEWEST_MOVING < moving.sum() < 0.9 * len(moving):
            still = moved < still_limit(self.size)
            now, then = now[~still], then[~still]
        inlier = epipolar_inliers(
            self._normalise(uv[then]),
            self._normalise(live.uv[now]),
            _EPIPOLAR_LIMIT / self.K[0, 0],
        )
        keep[now[~inlier]] = False
        self.live = live.keep(keep)

    def _normalise(self, uv: np.ndarray) -> np.ndarray:
        return rays(uv, self.K, self.distortion)

    def _is_sparse(self, k: int) -> bool:
        wanted, found = self.config.num_points, len(self.live.ids)
        since = k - self.last_refill
        return found < 0.5 * wanted or (found < 0.85 * wanted and since >= _REFILL_GAP)

    def _refill(self, gray: np.ndarray, mask: np.ndarray | None) -> None:
        """Finds lost points again, then new ones where the image lacks points."""
        wanted = self.config.num_points
        found = self._detect(gray, mask)
        if not found:
            return
        uv = np.array([p.pt for p in found], dtype=np.float64)
        response = np.array([p.response for p in found], dtype=np.float64)
        cell = -(-max(self.size) // CELLS)
        # Cells under a person or without texture give their share to the others.
        occupied = np.unique(uv.astype(np.int64) // cell, axis=0)
        quota = -(-wanted // max(len(occupied), 1))
        room = {"size": self.size, "cell": cell}
        some = spread(
            uv, response, self.live.uv, quota=2 * quota, distance=0.1 * cell, **room
        )[: 2 * wanted]
        self._revive(gray, [found[i] for i in some])
        chosen = spread(
            uv, response, self.live.uv, quota=quota, distance=0.2 * cell, **room
        )[: max(0, wanted - len(self.live.ids)) + wanted // 20]
        ids = np.arange(self.next_id, self.next_id + len(chosen))
        self.next_id += len(chosen)
        for i, which in zip(ids, chosen, strict=True):
            self.scale_of[int(i)] = found[which].size
        self.live = self.live.add(ids, uv[chosen])

    def _detect(self, gray: np.ndarray, mask: np.ndarray | None) -> list[cv2.KeyPoint]:
        """BRISK corners outside people; its threshold follows the texture."""
        wanted = self.config.num_points
        free = None if mask is None else cv2.bitwise_not(mask)
        while True:
            self.brisk.setThreshold(self.threshold)
            found = self.brisk.detect(gray, free)
            uv = np.array([p.pt for p in found], dtype=np.float64).reshape(-1, 2)
            inside = self._inside(uv, mask)
            if len(found) > 15 * wanted:
                self.threshold = min(round(self.threshold * 1.3), 80)
            elif inside.sum() < 3 * wanted and self.threshold > _LEAST_CONTRAST:
                self.threshold = max(round(self.threshold / 1.5), _LEAST_CONTRAST)
                if inside.sum() < wanted:
                    continue
            return [p for p, ok in zip(found, inside, strict=True) if ok]

    def _remember(self, gray: np.ndarray) -> None:
        """Describes the points of this frame, so that they can be found again."""
        points = []
        for row, (i, (x, y)) in enumerate(
            zip(self.live.ids, self.live.uv, strict=True)
        ):
            size = self.scale_of[int(i)]
            points.append(cv2.KeyPoint(float(x), float(y), size, class_id=row))
        kept, descriptors = self.brisk.compute(gray, points)
        if len(kept):
            rows = np.array([p.class_id for p in kept])
            self.keyframes.append(
                _Keyframe(gray, self.live.ids[rows], self.live.uv[rows], descriptors)
            )

    def _revive(self, gray: np.ndarray, found: list[cv2.KeyPoint]) -> None:
        """Continues lost tracks of older keyframes whose points are visible again.

        Descriptors are matched for a first position, optical flow from the keyframe's
        image refines it, and matches that are not inliers of the epipolar geometry
        between the two frames are rejected.
        """
        kept, descriptors = self.brisk.compute(gray, found)
        if not len(kept):
            return
        candidates = np.array([p.pt for p in kept], dtype=np.float64)
        for key in reversed(self.keyframes):
            lost = np.flatnonzero(~np.isin(key.ids, self.live.ids))
            pairs = match(key.descriptors[lost], descriptors)
            if len(pairs) < 4:
                continue
            then, guess = key.uv[lost[pairs[:, 0]]], candidates[pairs[:, 1]]
            now, ok = self._flow(key.image, gray, then, guess, 1)
            back, ok_back = self._flow(gray, key.image, now, then, 1)
            ok &= ok_back & (np.linalg.norm(back - then, axis=-1) < _ROUND_TRIP)
            ok &= np.linalg.norm(now - guess, axis=-1) < 4.0
            ids, then, now = key.ids[lost[pairs[ok, 0]]], then[ok], now[ok]
            _, a, b = np.intersect1d(key.ids, self.live.ids, return_indices=True)
            if not len(ids) or len(a) + len(ids) < 20:
                continue
            inlier = epipolar_inliers(
                self._normalise(np.concatenate([key.uv[a], then])),
                self._normalise(np.concatenate([self.live.uv[b], now])),
                _EPIPOLAR_LIMIT / self.K[0, 0],
            )[len(a) :]
            self.live = self.live.add(ids[inlier], now[inlier])
