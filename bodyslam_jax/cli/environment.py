"""`bodyslam doctor`: versions, devices, codecs, paths of models."""

import importlib.metadata
import os
import platform
import tempfile
from pathlib import Path

_PACKAGES = (
    "bodyslam-jax jax jaxlib equinox optimistix lineax jaxlie jaxopt optax numpy scipy "
    "opencv-python-headless onnxruntime trimesh matplotlib tyro"
).split()
NOT_INSTALLED = "not installed"
_CODECS = {"VP90": ".webm", "mp4v": ".mp4", "MJPG": ".avi"}


def doctor() -> None:
    """Prints versions, devices, networks and body models, and what works with them."""
    rows = report()
    rows.append(("verdict", verdict(rows)))
    width = max(len(name) for name, _ in rows)
    for name, finding in rows:
        print(f"{name:<{width}}  {finding}")


def report() -> list[tuple[str, str]]:
    """Returns rows of `(name, finding)`; a missing part is a finding, not an error."""
    rows = [("python", f"{platform.python_version()} on {platform.platform()}")]
    rows += [(name, _version(name)) for name in _PACKAGES]
    return rows + _devices() + _opencv() + _networks() + _models()


def verdict(rows: list[tuple[str, str]]) -> str:
    """Returns a sentence that says what works on the machine that the `rows` of
    `report` describe, and what does not."""
    found = dict(rows)
    missing = [name for name in _PACKAGES if found[name] == NOT_INSTALLED]
    if missing:
        return f"install again: {', '.join(missing)} is not there"
    if found["body in use"].startswith("none"):
        return "no run works: the body model is missing, see `body in use`"
    faults = [
        f"{name} ({text}): `run --detect none` with keypoints of your own works"
        for name, text in rows
        if name.startswith("network") and not text.startswith("runs")
    ]
    if found["video writer VP90"] != "present":
        faults.append("no VP9 writer: runs have no overlay.webm")
    if ", but " in found["body in use"]:
        faults.append("the motion model is of another body: see `body in use`")
    return "; ".join(faults) or "ready: `bodyslam demo`, `bodyslam run VIDEO`"


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return NOT_INSTALLED


def _devices() -> list[tuple[str, str]]:
    import jax

    found = ", ".join(str(device) for device in jax.devices())
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else "?"
    return [("devices", f"{found}; {cores} CPU cores")]


def _opencv() -> list[tuple[str, str]]:
    from bodyslam_jax import sfm

    return [("BRISK", sfm.brisk_status())] + [
        (f"video writer {codec}", _can_write(codec, suffix))
        for codec, suffix in _CODECS.items()
    ]


def _networks() -> list[tuple[str, str]]:
    from bodyslam_jax import people

    return [(f"network {name}", found) for name, found in people.network_status()]


def _can_write(codec: str, suffix: str) -> str:
    from bodyslam_jax import view

    with tempfile.TemporaryDirectory() as folder:
        works = view.can_write(Path(folder) / f"probe{suffix}", codec)
    return "present" if works else "absent"


def _models() -> list[tuple[str, str]]:
    from bodyslam_jax import body, motion

    rows = []
    for path in body.search_paths():
        rows.append(("body model", f"{path}: {'found' if path.exists() else 'no'}"))
    model = motion.load_motion_model()
    rows.append(("default motion model", f"for the {model.body} body"))
    try:
        found = body.load_body_model()
    except (OSError, ValueError) as error:
        return [*rows, ("body in use", f"none: {error}")]
    try:
        motion.check_compatible(model, found, model.fps)
    except ValueError as error:
        return [*rows, ("body in use", f"{found.name}, but {error}")]
    return [*rows, ("body in use", found.name)]
