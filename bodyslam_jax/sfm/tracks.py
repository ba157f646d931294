"""Tracks static points through images, about 200 a frame, spread over the image.

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
from bodyslam_jax.sfm.burnt_in import (
    MIN_MOVING_POINTS,
    MIN_MOVING_RATIO,
    still_limit,
)
from bodyslam_jax.sfm.features import (
    BRISK_THRESHOLD,
    epipolar_inliers,
    make_brisk,
    match,
    spread,
)
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Sequence, Tracks

_REFILL_GAP_FRAMES = 3
"""Number of frames between two searches for points, unless half of them are lost."""
_KEYFRAME_STEP_FRAMES = 12
"""Number of frames between two keyframes."""
_NUM_KEYFRAMES = 12
MAX_ROUND_TRIP_PX = 0.5
"""Largest forward-backward error of KLT, px: assumes that KLT localises a window to
clearly better than that, in images of any size."""
_MIN_BRISK_THRESHOLD = 6
"""Least threshold of BRISK, in images without contrast, grey levels."""
NUM_CELLS = 8
"""Number of cells along the longer side of the image, over which points are spread."""
KLT_WINDOW_PX = 21
"""Side of the window of Lucas--Kanade, px (OpenCV's default)."""
_MAX_EPIPOLAR_DISTANCE_PX = 1.5
"""Distance from the epipolar line beyond which a point is dropped, px: 3 σ of an
assumed tracking noise of 0.5 px at 640x480; not scaled with the image."""
_RIGID_GAP_FRAMES = 10
"""Number of frames over which points must fit one rigid motion."""
_PERSON_MARGIN = 0.06
"""Width that is masked around people's keypoints, relative to their height."""


Mask = UInt8[np.ndarray, "y x"]


def follow(
    sequence: Sequence,
    config: Tracking,
    *,
    hidden: Iterable[Mask] | None = None,
    look: Callable[[Mask], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Tracks points through the images of a sequence, in one pass.

    Args:
        hidden: a mask (255) for each frame, added to those of the people.
        look: called with each grey image.
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
    """Points that are being tracked, one a row."""

    ids: np.ndarray
    uv: np.ndarray
    step: np.ndarray
    """Last displacement, px a frame: the start of the next search."""

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
    """A frame with the descriptors of its points, by which they can be found again."""

    image: np.ndarray
    ids: np.ndarray
    uv: np.ndarray
    descriptors: np.ndarray


class _Tracker:
    """State of the tracker, whose memory does not grow with the number of images."""

    def __init__(self, sequence: Sequence, config: Tracking):
        self.config = config
        self.size = (sequence.intrinsics.width, sequence.intrinsics.height)
        self.K, self.distortion = as_opencv(sequence.intrinsics.params)
        self.brisk = make_brisk()
        self.live = _Live(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
        self.previous: np.ndarray | None = None
        self.recent: deque[tuple[np.ndarray, np.ndarray]] = deque(
            maxlen=_RIGID_GAP_FRAMES + 1
        )
        self.rows: list[tuple[int, np.ndarray, np.ndarray]] = []
        self.next_id = 0
        self.threshold = BRISK_THRESHOLD
        self.last_refill = -_REFILL_GAP_FRAMES
        self.keyframes: deque[_Keyframe] = deque(maxlen=_NUM_KEYFRAMES)
        self.last_keyframe = -_KEYFRAME_STEP_FRAMES
        self.scale_of: dict[int, float] = {}
        """Size of the BRISK keypoint of each point when it was detected, px."""

    def advance(self, k: int, gray: np.ndarray, mask: np.ndarray | None) -> None:
        if self.previous is not None and len(self.live.ids):
            self._follow(gray, mask)
            self._drop_moving()
        if self._is_sparse(k):
            self._refill(gray, mask)
            self.last_refill = k
            if k - self.last_keyframe >= _KEYFRAME_STEP_FRAMES:
                self._remember(gray)
                self.last_keyframe = k
        self.previous = gray
        self.recent.append((self.live.ids, self.live.uv))
        self.rows.append((k, self.live.ids, self.live.uv))

    def tracks(self) -> Tracks:
        """Returns all observations of points seen three times (in
        all frames, if fewer)."""
        frame = np.concatenate([np.full(len(i), k) for k, i, _ in self.rows])
        ids = np.concatenate([i for _, i, _ in self.rows])
        uv = np.concatenate([u for _, _, u in self.rows])
        count = np.bincount(ids, minlength=self.next_id)
        kept = count[ids] >= min(3, len(self.rows))
        _, landmark = np.unique(ids[kept], return_inverse=True)
        return Tracks(frame[kept], landmark.astype(np.int64), uv[kept])

    def _follow(self, image: np.ndarray, mask: np.ndarray | None) -> None:
        """Tracks points from the previous image by KLT, with forward-backward check."""
        assert self.previous is not None
        live = self.live
        guess = live.uv + live.step
        uv, ok = self._flow(self.previous, image, live.uv, guess)
        back, ok_back = self._flow(image, self.previous, uv, live.uv)
        ok &= ok_back & (np.linalg.norm(back - live.uv, axis=-1) < MAX_ROUND_TRIP_PX)
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
            winSize=(KLT_WINDOW_PX, KLT_WINDOW_PX),
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
        """Drops points that do not fit one rigid motion over the last frames."""
        live = self.live
        keep = np.ones(len(live.ids), dtype=bool)
        if not self.recent:
            return
        ids, uv = self.recent[0]
        _, now, then = np.intersect1d(live.ids, ids, return_indices=True)
        # Points that stay at their pixel fit every essential matrix without rotation:
        # if they are burnt into the image, the moving points would be dropped instead.
        moved = np.linalg.norm(live.uv[now] - uv[then], axis=-1)
        moving = moved > MIN_MOVING_RATIO * still_limit(self.size)
        if MIN_MOVING_POINTS < moving.sum() < 0.9 * len(moving):
            still = moved < still_limit(self.size)
            now, then = now[~still], then[~still]
        inlier = epipolar_inliers(
            self._normalise(uv[then]),
            self._normalise(live.uv[now]),
            _MAX_EPIPOLAR_DISTANCE_PX / self.K[0, 0],
        )
        keep[now[~inlier]] = False
        self.live = live.keep(keep)

    def _normalise(self, uv: np.ndarray) -> np.ndarray:
        return rays(uv, self.K, self.distortion)

    def _is_sparse(self, k: int) -> bool:
        wanted, found = self.config.num_points, len(self.live.ids)
        since = k - self.last_refill
        return found < 0.5 * wanted or (
            found < 0.85 * wanted and since >= _REFILL_GAP_FRAMES
        )

    def _refill(self, gray: np.ndarray, mask: np.ndarray | None) -> None:
        """Finds lost points again, then new ones where the image lacks points."""
        wanted = self.config.num_points
        found = self._detect(gray, mask)
        if not found:
            return
        uv = np.array([p.pt for p in found], dtype=np.float64)
        response = np.array([p.response for p in found], dtype=np.float64)
        cell = -(-max(self.size) // NUM_CELLS)
        # The quota of cells under a person or without texture goes to the others.
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
        """Detects BRISK corners outside people; the threshold adapts to texture."""
        wanted = self.config.num_points
        free = None if mask is None else cv2.bitwise_not(mask)
        while True:
            self.brisk.setThreshold(self.threshold)
            found = self.brisk.detect(gray, free)
            uv = np.array([p.pt for p in found], dtype=np.float64).reshape(-1, 2)
            inside = self._inside(uv, mask)
            if len(found) > 15 * wanted:
                self.threshold = min(round(self.threshold * 1.3), 80)
            elif inside.sum() < 3 * wanted and self.threshold > _MIN_BRISK_THRESHOLD:
                self.threshold = max(round(self.threshold / 1.5), _MIN_BRISK_THRESHOLD)
                if inside.sum() < wanted:
                    continue
            return [p for p, ok in zip(found, inside, strict=True) if ok]

    def _remember(self, gray: np.ndarray) -> None:
        """Adds a keyframe with the descriptors of this frame's points."""
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
            ok &= ok_back & (np.linalg.norm(back - then, axis=-1) < MAX_ROUND_TRIP_PX)
            ok &= np.linalg.norm(now - guess, axis=-1) < 4.0
            ids, then, now = key.ids[lost[pairs[ok, 0]]], then[ok], now[ok]
            _, a, b = np.intersect1d(key.ids, self.live.ids, return_indices=True)
            if not len(ids) or len(a) + len(ids) < 20:
                continue
            inlier = epipolar_inliers(
                self._normalise(np.concatenate([key.uv[a], then])),
                self._normalise(np.concatenate([self.live.uv[b], now])),
                _MAX_EPIPOLAR_DISTANCE_PX / self.K[0, 0],
            )[len(a) :]
            self.live = self.live.add(ids[inlier], now[inlier])
