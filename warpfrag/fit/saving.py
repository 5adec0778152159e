"""The folder that a fit is saved in: images, plots, and everything else as result.json."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpfrag.files.images import write_image
from warpfrag.files.saving import replacing
from warpfrag.fit.plots import draw_error, draw_loss
from warpfrag.fit.result import FitResult, Run
from warpfrag.versions import package_versions

# Arrays with more numbers than this are written beside result.json, not into it.
MOST_NUMBERS = 256
RESULT, ARRAYS = "result.json", "parameters.npz"


def save_result(result: FitResult, folder: str | Path) -> None:
    """Write images, plots and result.json to a folder, made if need be; the images of several views to one each.

    Raises:
        ImageError: a file cannot be written.
        ImportError: matplotlib is not installed.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for view in result.views:
        place = folder / view.name if len(result.views) > 1 else folder
        place.mkdir(exist_ok=True)
        for name in ("reference", "before", "after"):
            write_image(place / f"{name}.png", getattr(view, name))
        draw_error(view, place / "error.png")
    draw_loss(result, folder / "loss.png")
    arrays: dict[str, np.ndarray] = {}
    content = to_json(result, arrays)
    if arrays:
        with replacing(folder / ARRAYS) as partial:
            np.savez(partial, **arrays)  # type: ignore[arg-type]
    with replacing(folder / RESULT) as partial:
        partial.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def to_json(result: FitResult, arrays: dict[str, np.ndarray] | None = None) -> dict[str, Any]:
    """Return everything but the images as plain values; large arrays go to `arrays`, if it is given."""
    return {
        "start": _plain_values("start", result.start, arrays),
        "found": _plain_values("found", result.found, arrays),
        "true": _plain_values("true", result.true, arrays),
        "relative_errors": _plain(result.relative_errors()),
        "standard_errors": _plain_values("standard_errors", result.standard_errors, arrays),
        "condition_number": _plain(result.condition_number),
        "undetermined": list(result.undetermined),
        "unseen": list(result.unseen),
        "notes": list(result.notes),
        "loss": _plain(result.loss),
        "losses": _plain(list(result.losses)),
        "steps": result.steps,
        "evaluations": result.evaluations,
        "seconds": result.seconds,
        "converged": result.converged,
        "reason": result.reason,
        "views": [_plain({"name": v.name, "held_out": v.held_out, "psnr": v.psnr}) for v in result.views],
        "runs": [_run_to_json(index, run, arrays) for index, run in enumerate(result.runs)],
        **_plain(result.setting),
        "versions": package_versions(),
    }


def _run_to_json(index: int, run: Run, arrays: dict[str, np.ndarray] | None) -> dict[str, Any]:
    return {
        "start": _plain_values(f"runs.{index}.start", run.start, arrays),
        "found": _plain_values(f"runs.{index}.found", run.found, arrays),
        "loss": _plain(run.loss),
        "steps": len(run.losses),
        "evaluations": run.evaluations,
        "converged": run.converged,
        "reason": run.reason,
    }


def _plain_values(kind: str, values: Mapping[str, Any] | None, arrays: dict[str, np.ndarray] | None) -> Any:
    if values is None:
        return None
    result = {}
    for name, value in values.items():
        array = np.asarray(value)
        if arrays is not None and array.size > MOST_NUMBERS:
            arrays[f"{kind}.{name}"] = array
            result[name] = {"shape": list(array.shape), "mean": _plain(float(array.mean())), "file": ARRAYS}
        else:
            result[name] = _plain(array.tolist())
    return result


def _plain(value: Any) -> Any:
    """Return a value as JSON takes it: what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value
