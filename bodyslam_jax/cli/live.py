"""`bodyslam live`: the estimate while a video, a camera or a stream runs."""

import contextlib
import datetime
import logging
import time
import webbrowser
from pathlib import Path
from typing import Any

import tyro

from bodyslam_jax.cli import interrupts, unexpected
from bodyslam_jax.cli.estimate import finish
from bodyslam_jax.cli.options import Flat, Preset
from bodyslam_jax.config import Config

log = logging.getLogger(__name__)

_SILENCE_WARNING_S, _MAX_SILENCE_S = 5.0, 30.0
"""Time without an image, s, after which there is a warning, and after which the source
has ended."""
_PICTURE_INTERVAL_S = 0.1
"""Least time between two pictures on the page, s."""
_PROGRESS_INTERVAL_S = 5.0
"""Time between two lines of progress, s."""
_STATE_INTERVAL_S, _MAX_STATE_SHARE = 60.0, 0.02
"""Least time between two states of a file that is read with `--every-frame`, s, and
largest share of the time that goes into writing them."""


def live(
    source: tyro.conf.Positional[str],
    /,
    *,
    out: Path | None = None,
    camera: Path | None = None,
    page: bool = True,
    port: int = 0,
    open: bool = False,
    every_frame: bool = False,
    smooth: bool = False,
    preset: Preset = "default",
    settings: Path | None = None,
    config: Flat = Config(),
) -> int:
    """Estimates camera, people and map in metres while a video runs, until Ctrl-C.

    A page on this machine only shows picture and scene as they grow. At the end of the
    source, or after Ctrl-C, the run folder is written; a second Ctrl-C gives up. With
    --every-frame Ctrl-C keeps the state, and the same command goes on.

    Args:
        source: Video file, which runs at its own pace; number of a camera (0); or
            address of a stream that OpenCV opens (rtsp://, http://).
        out: Run folder to write. Without it runs/NAME, numbered if one is there.
        camera: Calibration, as of `run`. Without it, or --focal or --fov, the focal
            length is guessed and not refined.
        page: Whether a page is served; without it, progress is told in lines.
        port: Port of the page; 0 takes a free one.
        open: Open the page in the default browser.
        every_frame: Read a file as fast as its frames are estimated, in place of its
            own pace: none is dropped, and the same file gives the same estimate. For
            videos that are too long for `run`: it needs the memory of a window, and
            goes on where it was interrupted.
        smooth: After the end estimate everything once more, offline, from the points
            and keypoints that were recorded; it takes as long as `run` without its
            images.
        preset: `paper` selects the paper's weights and motion network.
        settings: Settings file (config.yaml); it overrides the preset, and options
            override both.
        config: Settings of every stage; what is known of a whole video (--start,
            --end, --height, --camera-path, --person) is refused.
    """
    from bodyslam_jax import export
    from bodyslam_jax.config.errors import InputError
    from bodyslam_jax.io.camera.calibration import read_camera
    from bodyslam_jax.io.capture import Capture
    from bodyslam_jax.online import Online
    from bodyslam_jax.pipeline.progress import compiling
    from bodyslam_jax.pipeline.stage_cache import fingerprint

    if options := refused(config):
        raise InputError(
            f"{options[0]}: is of a whole video, which `live` and `run --windows "
            "always` do not use; use `bodyslam run`."
        )
    # It has a line for each window.
    logging.getLogger("bodyslam_jax.people.fit").setLevel(logging.WARNING)
    capture = Capture(source, config.fps, every=every_frame)
    with contextlib.ExitStack() as held:
        held.callback(capture.close)
        intrinsics = None if camera is None else read_camera(camera, capture.size)[0]
        name = _name(source)
        key = None
        if every_frame:
            key = fingerprint(capture.path, capture.fps, intrinsics, smooth, config)
        out = out or _folder(name, key)
        export.check_folder(out, {"name": name}, None)
        held.enter_context(export.locked(out))
        online = Online(
            config,
            intrinsics=intrinsics,
            fps=capture.fps,
            threads=not every_frame,
            name=name,
            smooth=smooth,
        )
        log.info("live: %s at %.3g frames a second -> %s", source, capture.fps, out)
        width, height = capture.size
        with compiling("live", f"{width}x{height} px"):
            online.prepare(capture.size)
        states = None if key is None else _States(online, _state_file(out, key))
        if states is not None:
            export.clear_partial(out)
            states.resume(capture)
        shown = _page(page, port, open)
        if shown is not None:
            held.callback(shown.close)
        with interrupts.as_event() as stop:
            indices = _follow(capture, online, shown, stop, states)
        if states is not None and stop.is_set():
            states.save()
            raise KeyboardInterrupt
        if capture.dropped:
            online.warn(
                f"{capture.dropped} of {capture.dropped + len(indices)} frames were "
                "dropped, as newer ones came before they were used, and are "
                "interpolated in the result"
            )
        if capture.path is not None:
            online.video, online.picks = capture.path, indices
        with unexpected.noted_in(out):
            result = online.finish()
            if smooth:
                result = _smoothed(online, result)
            _write_folder(online, result, out)
        if states is not None:
            states.remove()
    return finish(result, out)


def _folder(name: str, key: str | None) -> Path:
    """Returns a new folder for a run, or that of an interrupted one with the same
    `key`."""
    from bodyslam_jax.cli.folders import free_folder

    if key is None:
        return free_folder(name)
    return free_folder(name, lambda folder: _state_file(folder, key).is_file())


def _state_file(out: Path, key: str) -> Path:
    """Returns the file of the estimate's state, for one input and its settings."""
    return out / ".cache" / f"live-{key}.state"


class _States:
    """The state of an estimate that is written every now and then."""

    def __init__(self, online: Any, path: Path) -> None:
        self.online, self.path = online, path
        self.written, self.took = time.monotonic(), 0.0

    def resume(self, capture: Any) -> None:
        """Goes on where an earlier process wrote the state, if one did."""
        from bodyslam_jax.online import checkpoint

        if checkpoint.resume(self.online, self.path):
            frames = self.online.counts.frames
            log.info("live: goes on after frame %d, where it was interrupted", frames)
            capture.skip(frames)

    def save_at_times(self) -> None:
        """Writes the state, if that was done long enough ago."""
        since = time.monotonic() - self.written
        if since >= max(_STATE_INTERVAL_S, self.took / _MAX_STATE_SHARE):
            self.save()

    def save(self) -> None:
        from bodyslam_jax.online import checkpoint

        begun = time.monotonic()
        checkpoint.save(self.online, self.path)
        self.written = time.monotonic()
        self.took = self.written - begun

    def remove(self) -> None:
        """Removes the file, and the states of other settings."""
        for path in self.path.parent.glob("live-*.state"):
            path.unlink()
        with contextlib.suppress(OSError):  # It may be the cache of a run, too.
            self.path.parent.rmdir()


def _smoothed(online: Any, result: Any) -> Any:
    """Returns the result of a last offline pass; if that fails, `result` with a warning
    that says why."""
    from bodyslam_jax.config.errors import InputError

    log.info("live: a last offline pass over %d frames", len(result.timestamps))
    try:
        return online.smooth()
    except InputError as error:
        line = f"no last offline pass, so this is the estimate of the live run: {error}"
        result.summary["warnings"].append(line)
        log.warning(line)
        return result


def _write_folder(online: Any, result: Any, out: Path) -> None:
    """Writes what `online.finish` returned as `run` does; with an overlay where the
    frames are those of a file (`Online.video`), as no image is kept.

    The caller holds the folder's lock.

    **Raises:** `InputError` if `out` cannot be written or holds something else.
    """
    from bodyslam_jax import export
    from bodyslam_jax.pipeline.progress import Stopwatch
    from bodyslam_jax.pipeline.run_folder import check_overlay, write_pictures

    check_overlay(online.config)
    watch = Stopwatch()
    with export.run_folder(out) as partial:
        measured, cameras = online.inputs
        given = measured, cameras, result, online.body, online.config, watch
        still = write_pictures(partial, *given)
        result.summary["durations_s"] |= watch.seconds
        export.write_files(partial, result, online.config)
        export.write_report(partial / "report.html", result, online.body, still)


def refused(config: Config) -> list[str]:
    """Returns the options that describe a whole video, which does not exist yet."""
    names = ("start", "end", "camera_path", "person", "height")
    found = [n for n in names if getattr(config, n) not in (None, False, ())]
    return ["--" + name.replace("_", "-") for name in found]


def _page(wanted: bool, port: int, open: bool) -> Any:
    if not wanted:
        return None
    from bodyslam_jax.view.live_page import LivePage
    from bodyslam_jax.view.serve import address_of

    page = LivePage(port)
    print(f"{address_of(page.server)} (Ctrl-C ends it)", flush=True)
    if open:
        webbrowser.open(address_of(page.server))
    return page


def _follow(
    capture: Any, online: Any, page: Any, stop: Any, states: _States | None
) -> list[int]:
    """Passes images to the estimate until the source ends or the user stops it; returns
    the numbers of all images in the source that it was given, also by an earlier
    process."""
    indices = list(range(capture.skipped))
    latencies: list[float] = []
    told, drawn, begun = 0.0, 0.0, time.monotonic()
    silent = False
    if capture.every:
        log.info("live ...", extra={"stage": "live"})
    capture.start()
    while not stop.is_set():
        found = capture.newest(timeout=0.5)
        now = time.monotonic()
        if found is None:
            if capture.ended:
                break
            if capture.silent() > _SILENCE_WARNING_S and not silent:
                silent = True
                log.warning(
                    "%s: no image for %.0f s", capture.source, _SILENCE_WARNING_S
                )
            if capture.silent() > _MAX_SILENCE_S:
                online.warn(f"the source gave no image for {_MAX_SILENCE_S:.0f} s")
                break
            continue
        silent = False
        estimate = online.update(found.image, found.timestamp)
        indices.append(found.index)
        latencies = [*latencies[-99:], estimate.latency]
        late = sorted(latencies)[int(0.95 * (len(latencies) - 1))]
        here = len(indices) - capture.skipped
        rate = here / max(time.monotonic() - begun, 1e-9)
        looks = online.counts.looks / max(online.counts.frames, 1) * rate
        figures = _figures(estimate, rate, looks, late, capture.dropped)
        done = {}
        if capture.every and capture.length is not None:
            total = max(capture.length - capture.skipped, here)
            left = round((total - here) / max(rate, 1e-9))
            figures["time left"] = str(datetime.timedelta(seconds=left))
            done = {"stage": "live", "done": here, "total": total}
        if page is not None and now - drawn >= _PICTURE_INTERVAL_S:
            drawn = now
            page.show(
                found.image,
                online.points,
                online.drawn(estimate),
                estimate.T_WC,
                {"figures": figures, "notes": estimate.notes},
            )
        if now - told >= _PROGRESS_INTERVAL_S:
            told = now
            line = ", ".join(f"{k} {v}" for k, v in figures.items())
            log.info(line, extra=done)
        if states is not None:
            states.save_at_times()
    return indices


def _figures(
    estimate: Any, rate: float, looks: float, late: float, dropped: int
) -> dict[str, str]:
    relative = estimate.scale_sigma / estimate.scale
    known = relative == relative
    return {
        "status": estimate.status,
        "time": f"{estimate.timestamp:.1f} s",
        "frames a second": f"{rate:.1f} ({looks:.1f} of them searched for people)",
        "latency (95 %)": f"{1000 * late:.0f} ms",
        "dropped": str(dropped),
        "people": str(len(estimate.people)),
        "sizes": f"known to {100 * relative:.0f} %" if known else "unknown",
        "scale": f"{estimate.scale:.3f} ± {estimate.scale_sigma:.3f} m per unit"
        if known
        else "unknown",
    }


def _name(source: str) -> str:
    """Returns the name of the run of a source."""
    path = Path(source)
    if path.is_file():
        return path.stem
    return f"camera-{source}" if source.isdecimal() else "stream"
