"""`bodyslam view`: a run in 3D, in a browser."""

import logging
import webbrowser
from pathlib import Path
from typing import Any

from bodyslam_jax.cli.options import Input

log = logging.getLogger(__name__)


def view(
    run: Input,
    /,
    *,
    compare: Path | None = None,
    port: int = 0,
    open: bool = False,
    body_model: Path | None = None,
) -> None:
    """Shows a run in 3D in a browser, on this machine only, until Ctrl-C.

    The page has a box for what the joint estimate started from. `RUN/scene.html` shows
    the run alone, without a server.

    Args:
        run: Run folder.
        compare: Second run folder, drawn fainter in the same scene.
        port: Port to serve on; 0 takes a free one.
        open: Open the page in the default browser.
        body_model: The body model of the runs; without it the one that `bodyslam
            doctor` shows. What a run folder names is not opened.
    """
    from bodyslam_jax.view import scene_page
    from bodyslam_jax.view.serve import address_of, page_server

    runs = _runs(run, body_model)
    if compare is not None:
        other = _runs(compare, body_model)[0]
        runs.insert(1, other | {"label": str(compare)})
    with page_server(scene_page(runs), run, port) as server:
        print(f"{address_of(server)} (Ctrl-C ends it)", flush=True)
        if open:
            webbrowser.open(address_of(server))
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            log.info("ended")


def _runs(run: Path, body_model: Path | None) -> list[dict[str, Any]]:
    """Returns the data of the run for the page, read from its own page if it has one,
    and those of its start if the run folder has it."""
    import bodyslam_jax as bs
    from bodyslam_jax import evaluation, view
    from bodyslam_jax.pipeline.run_folder import start_of_joint

    result = evaluation.read_result(run)
    has_page = (run / "scene.html").exists()
    try:
        if body_model is None:
            body = evaluation.body_of_run(result)
        else:
            body = bs.load_body_model(body_model)
            evaluation.check_body(result, body)
    except ValueError as error:
        if body_model is not None or not has_page:
            raise
        # The page has all that it shows, but for what the joint estimate started from.
        log.warning("what the run started from is left out: %s", error)
        return view.read_runs(run / "scene.html")[:1]
    if has_page:
        runs = view.read_runs(run / "scene.html")[:1]
    else:
        runs = [view.scene_data(result, body)]
    start = start_of_joint(run, result, body)
    if start is not None:
        label = {"label": "before the joint estimate", "hidden": True}
        runs.append(view.scene_data(start, body) | label)
    return runs
