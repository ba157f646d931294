"""A process that reads inputs for the fuzzer, one at a time, under limits.

A line of JSON comes in with a target and a path; a line goes out with how it ended.
"""

import dataclasses
import json
import math
import os
import resource
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import numpy as np

MAX_GROWTH_BYTES = 2 << 30
"""Resident memory that an input may take."""
MAX_SECONDS = 10.0
"""Processor time that an input may take."""
MAX_LETTERS = 2_000
"""Of a message: what it quotes of a file is bounded."""
_AROUND_BYTES = 4 << 30
"""Address space above what the process has when it starts: libraries reserve more than
they use."""


def _status(name: str) -> int:
    """A size of this process, bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    return 0


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def not_finite(value: Any, place: str = "result", depth: int = 0) -> str:
    """Where a result has a number that is not finite; empty if nowhere."""
    if depth > 8:
        return ""
    if isinstance(value, float):
        return "" if math.isfinite(value) else place
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        array = np.asarray(value) if value.dtype.kind in "fc" else np.zeros(0)
        return "" if np.isfinite(array).all() else place
    if isinstance(value, dict):
        parts = value.items()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        parts = (
            (f.name, getattr(value, f.name, None)) for f in dataclasses.fields(value)
        )
    elif isinstance(value, (list, tuple)):
        parts = enumerate(value[:10_000])
    else:
        return ""
    for name, part in parts:
        if found := not_finite(part, f"{place}.{str(name)[:40]}", depth + 1):
            return found
    return ""


def judged(
    read: Any, path: Path, may_be_nan: tuple[str, ...], home: Path | None = None
) -> dict[str, Any]:
    """How reading an input ends: `ok`, `refused`, or `bad` with what is wrong.

    `home` is the folder of the input and of what belongs to it.
    """
    from bodyslam_jax.config.errors import InputError

    named = [path.name, str(path.parent), str(home or path.parent)]
    try:
        result = read(path)
    except InputError as error:
        for text in error.lines:  # a manifest has a line for each mistake
            if "\n" in text or not text.isprintable():
                return {"end": "bad", "why": f"several lines: {text[:200]!r}"}
            if len(text) > MAX_LETTERS:
                return {"end": "bad", "why": f"message of {len(text)} letters"}
            if not any(name in text for name in named):
                return {"end": "bad", "why": f"no file in it: {text[:200]!r}"}
        return {"end": "refused", "why": str(error)[:200]}
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if "bodyslam_jax" in f.filename] or frames
        where = f"{Path(own[-1].filename).name}:{own[-1].lineno}"
        words = " ".join(str(error).split())[:160]
        return {"end": "bad", "why": f"{type(error).__name__} at {where}: {words}"}
    place = not_finite(result)
    if place and not place.endswith(may_be_nan or ("\0",)):
        return {"end": "bad", "why": f"accepted, but {place} is not finite"}
    return {"end": "ok", "why": ""}


def main() -> None:
    # Answers have a channel of their own: libraries print to standard output.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    warnings.simplefilter("ignore")
    import logging

    logging.disable(logging.CRITICAL)
    import fuzz_targets

    reads = {target.name: target for target in fuzz_targets.TARGETS}
    fuzz_targets.warm_up()
    most = _status("VmSize") + _AROUND_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print(json.dumps({"end": "ready"}), file=answers, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        target = reads[job["target"]]
        _forget_peak()
        # Time of the processor: the machine may be doing other things.
        before, start = _status("VmRSS"), time.process_time()
        path = Path(job["path"])
        home = path.parents[len(Path(target.file).parts) - 1]
        answer = judged(target.read, path, target.may_be_nan, home)
        answer["seconds"] = time.process_time() - start
        answer["growth"] = max(0, _status("VmHWM") - before)
        if answer["seconds"] > MAX_SECONDS:
            answer |= {"end": "bad", "why": f"took {answer['seconds']:.0f} s"}
        if answer["growth"] > MAX_GROWTH_BYTES:
            answer |= {"end": "bad", "why": f"{answer['growth'] / 1e9:.1f} GB taken"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
