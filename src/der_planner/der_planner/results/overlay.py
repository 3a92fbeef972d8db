"""Measured and planned limbs over the camera's frames: as a figure, and as a film."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes

from der_planner.arrays import Array
from der_planner.bags.images import Picture, Projection, RunImages, Snapshot
from der_planner.bags.run import EvaluationError, RunSeries
from der_planner.results.figures import (
    CM,
    DASHES,
    FORMATS,
    PAGE,
    REFERENCE,
    by_motion,
    colour,
    new_figure,
    paper_style,
    save,
    shared_legend,
)

INSTANTS = 5


def plot_shapes(
    runs: Sequence[RunSeries], folder: Path, formats: tuple[str, ...] = FORMATS
) -> list[Path]:
    """Draw reference, DER and PCC limb at five instants, over the camera's frames where recorded.

    A row per motion. The first trial of each model is drawn; frames come from the first run that
    has them. The reference limb is the shape that the planner published.

    Args:
        runs: any; those without a bag are left out.
        folder: where ``shapes.png`` and ``shapes.pdf`` go.
        formats: file name endings.

    Returns:
        The written files; none where no run has a bag.
    """
    motions = by_motion([run for run in runs if run.origin])
    if not motions:
        return []
    with paper_style():
        figure = new_figure(PAGE, 0.4 + 1.6 * len(motions))
        axes = figure.subplots(len(motions), INSTANTS, squeeze=False)
        for row, (title, members) in zip(axes, motions.items(), strict=True):
            _draw_row(row, members)
            row[0].set_ylabel(title)
        shared_legend(figure, axes.flat)
        return save(figure, folder, "shapes", formats)


def _draw_row(row: Sequence[Axes], runs: Sequence[RunSeries]) -> None:
    first: dict[str, RunSeries] = {}
    for run in runs:
        first.setdefault(run.description.model, run)
    chosen = list(first.values())
    last = min(float(run.reference.time[-1]) for run in chosen)
    times = np.linspace(0.1, 0.9, INSTANTS) * last
    shots: dict[str, list[Snapshot]] = {}
    background, project = None, None
    for run in chosen:
        with RunImages(run) as images:
            shots[run.description.model] = [images.snapshot(time) for time in times]
            if background is None and shots[run.description.model][0].picture is not None:
                background, project = run.description.model, images.projection()
    for index, axis in enumerate(row):
        under = None
        if background is not None and project is not None:
            under = shots[background][index].picture
        _draw_shot(axis, {model: shot[index] for model, shot in shots.items()}, under, project)
        axis.set_title(f"{times[index]:.1f} s")
    _zoom(row)


def _zoom(row: Sequence[Axes]) -> None:
    """Show the same part of the plane in every picture: where the limbs are, and some margin."""
    drawn = [line.get_xydata() for axis in row for line in axis.get_lines()]
    if not drawn:
        return
    points = np.vstack(drawn)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.12 * float((high - low).max())
    for axis in row:
        axis.set_xlim(low[0] - margin, high[0] + margin)
        upside_down = axis.yaxis_inverted()
        axis.set_ylim(low[1] - margin, high[1] + margin)
        axis.yaxis.set_inverted(upside_down)


def _draw_shot(
    axis: Axes,
    shots: dict[str, Snapshot],
    frame: Picture | None,
    project: Projection | None,
) -> None:
    place: Callable[[Array], Array] = lambda points: points * CM  # noqa: E731
    if frame is not None and project is not None:
        axis.imshow(frame, cmap="gray", vmin=0, vmax=255, alpha=0.75)
        place = project
    planned = next((shot.planned for shot in shots.values() if len(shot.planned)), None)
    if planned is not None:
        line = place(planned)
        if frame is not None:
            axis.plot(line[:, 0], line[:, 1], color="white", lw=1.8)
        axis.plot(line[:, 0], line[:, 1], color=REFERENCE, ls=":", lw=1.0, label="planned")
    for index, (model, shot) in enumerate(shots.items()):
        if len(shot.measured):
            line = place(shot.measured)
            look, dash = colour(model, index), DASHES.get(model, "-.")
            axis.plot(line[:, 0], line[:, 1], color=look, ls=dash, lw=1.0, label=model.upper())
    axis.set_aspect("equal")
    axis.set(xticks=[], yticks=[])
    for side in axis.spines.values():
        side.set_visible(False)


def write_video(
    run: RunSeries, path: Path, progress: Callable[[float], None] | None = None
) -> Path:
    """Write an MP4 of the camera's frames with the measured curve, tip and reference tip drawn in.

    Args:
        run: of a bag with images.
        path: of the film; its folder exists.
        progress: called with the fraction done.

    Raises:
        EvaluationError: the bag has no images, calibration or tags, or the film cannot be written.
    """
    bag = run.description.bag
    film: cv2.VideoWriter | None = None
    with RunImages(run) as images:
        project = images.projection()
        if project is None:
            raise EvaluationError(f"{bag}: no camera calibration or too few limb tags")
        for time, picture, curve in images.pictures():
            film = film or _open_film(path, run, picture)
            film.write(_film_frame(picture, time, curve, run, project))
            if progress is not None:
                progress(min(1.0, max(0.0, time / float(run.reference.time[-1]))))
    if film is None:
        raise EvaluationError(
            f"{bag}: holds no images of a known encoding; record them with record_images:=true"
        )
    film.release()
    return path


def _open_film(path: Path, run: RunSeries, frame: Picture) -> cv2.VideoWriter:
    rate = 1.0 / float(np.median(np.diff(run.tip.time)))
    height, width = frame.shape
    code = cv2.VideoWriter.fourcc(*"mp4v")
    film = cv2.VideoWriter(str(path), code, rate, (width, height))
    if not film.isOpened():
        raise EvaluationError(f"cannot write the film {path}: is its folder writable?")
    return film


def _film_frame(
    frame: Picture,
    time: float,
    curve: Array,
    run: RunSeries,
    project: Projection,
) -> Picture:
    picture = np.asarray(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    red, green, blue = (int(colour(run.description.model)[i : i + 2], 16) for i in (1, 3, 5))
    paint = (blue, green, red)
    path = np.rint(project(run.reference.value)).astype(np.int32)
    cv2.polylines(picture, [path], False, (255, 255, 255), 1, cv2.LINE_AA)
    if len(curve):
        line = np.rint(project(curve)).astype(np.int32)
        cv2.polylines(picture, [line], False, paint, 3, cv2.LINE_AA)
        cv2.circle(picture, line[-1].tolist(), 7, paint, -1, cv2.LINE_AA)
    if 0.0 <= time <= run.reference.time[-1]:
        asked = [[np.interp(time, run.reference.time, column) for column in run.reference.value.T]]
        centre = np.rint(project(np.array(asked)))[0].astype(int).tolist()
        cv2.circle(picture, centre, 9, (255, 255, 255), 2, cv2.LINE_AA)
    text = f"{run.description.motion} {run.description.model}  {time:6.2f} s"
    cv2.putText(picture, text, (16, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2)
    return picture
