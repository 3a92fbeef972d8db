"""Measured and planned limbs over the camera's frames: as a figure, and as a film."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from der_planner.arrays import Array
from der_planner.bags.reader import BagReader
from der_planner.bags.run import EvaluationError, RunSeries
from der_planner.results.figures import (
    DASHES,
    PAGE,
    REFERENCE,
    by_motion,
    colour,
    paper_style,
    save,
    shared_legend,
)
from der_planner.results.scenes import Picture, Projection, RunImages, Snapshot
from der_planner.results.tables import CM

INSTANTS = 5
"""Pictures in a row of the figure."""

ANIMATION_WIDTH = 560
"""Of an animated picture [px]."""
ANIMATION_STEP = 0.15
"""From one of its frames to the next [s]."""
ANIMATION_QUALITY = 45
"""Of 100."""

Frames = Iterator[tuple[float, Picture]]
"""Times [s] and pictures of a film."""


def plot_shapes(runs: Sequence[RunSeries], folder: Path) -> list[Path]:
    """Draw reference, DER and PCC limb at five instants, over the camera's frames where recorded.

    A row per motion. The first trial of each model is drawn; frames come from the first run that
    has them. The reference limb is the shape that the planner published.

    Args:
        runs: any; those without a bag are left out.
        folder: where ``shapes.png`` and ``shapes.pdf`` go.

    Returns:
        The written files; none where no run has a bag.
    """
    motions = by_motion([run for run in runs if run.origin])
    if not motions:
        return []
    with paper_style():
        figure = Figure(figsize=(PAGE, 0.4 + 1.6 * len(motions)))
        axes = figure.subplots(len(motions), INSTANTS, squeeze=False)
        for row, (title, members) in zip(axes, motions.items(), strict=True):
            _draw_row(row, members)
            row[0].set_ylabel(title)
        shared_legend(figure, axes.flat)
        return save(figure, folder, "shapes")


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
        with BagReader(run.description.bag) as bag:
            images = RunImages(bag, run)
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


def write_video(run: RunSeries, path: Path) -> Path:
    """Write a film of the camera's frames with reference path, planned and measured limb drawn in.

    Args:
        run: of a bag with images.
        path: of the film, an MP4, or a small animated picture of the motion alone where it ends
            in ``.webp``; its folder exists.

    Raises:
        EvaluationError: the bag has no images, calibration or tags, or the film cannot be written.
    """
    path_of_bag = run.description.bag
    with BagReader(path_of_bag) as bag:
        images = RunImages(bag, run)
        project = images.projection()
        if project is None:
            raise EvaluationError(f"{path_of_bag}: no camera calibration or too few limb tags")
        frames = ((time, _film_frame(shot, time, run, project)) for time, shot in images.pictures())
        write = _write_animation if path.suffix == ".webp" else _write_film
        if not write(run, path, frames):
            raise EvaluationError(
                f"{path_of_bag}: no images of a known encoding: record them, by --record-images of "
                "an experiment or record_images of the recorder"
            )
    return path


def _write_film(run: RunSeries, path: Path, frames: Frames) -> int:
    """Write the frames as fast as they were taken; return how many."""
    rate, count = 1.0 / float(np.median(np.diff(run.tip.time))), 0
    film = cv2.VideoWriter()
    for time, frame in frames:
        if not count:
            begin, held = time, frame
        size = (frame.shape[1], frame.shape[0])
        if not count and not film.open(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size):
            raise EvaluationError(f"OpenCV cannot write the film {path}")
        # A picture stands until the next one where the camera misses some.
        missed = max(round(rate * (time - begin)) - count, 0)
        for each in (*[held] * missed, frame):
            film.write(each)
        count, held = count + missed + 1, frame
    film.release()
    return count


def _write_animation(run: RunSeries, path: Path, frames: Frames) -> int:
    """Write some frames of the motion; return how many."""
    animation, kept, due = cv2.Animation(), [], 0.0
    for time, frame in frames:
        if due <= time <= run.reference.time[-1]:
            height = round(ANIMATION_WIDTH * frame.shape[0] / frame.shape[1])
            kept.append(cv2.resize(frame, (ANIMATION_WIDTH, height), interpolation=cv2.INTER_AREA))
            due = time + ANIMATION_STEP - 0.01
    animation.frames = kept
    animation.durations = [round(1000 * ANIMATION_STEP)] * len(kept)
    quality = [cv2.IMWRITE_WEBP_QUALITY, ANIMATION_QUALITY]
    if kept and not cv2.imwriteanimation(str(path), animation, quality):
        raise EvaluationError(f"OpenCV cannot write the film {path}")
    return len(kept)


def _film_frame(shot: Snapshot, time: float, run: RunSeries, project: Projection) -> Picture:
    picture = np.asarray(cv2.cvtColor(shot.picture, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    red, green, blue = (int(colour(run.description.model)[i : i + 2], 16) for i in (1, 3, 5))
    paint, white = (blue, green, red), (255, 255, 255)

    def draw(points: Array, color: tuple[int, int, int], width: int) -> None:
        line = np.rint(project(points)).astype(np.int32)
        cv2.polylines(picture, [line], False, color, width, cv2.LINE_AA)

    draw(run.reference.value, white, 1)
    if len(shot.measured):
        draw(shot.measured, paint, 9)
        tip = np.rint(project(shot.measured[-1:]))[0].astype(int).tolist()
        cv2.circle(picture, tip, 11, paint, -1, cv2.LINE_AA)
    draw(shot.planned, white, 2)
    if 0.0 <= time <= run.reference.time[-1]:
        centre = np.rint(project(run.reference.at(np.array([time]))))[0].astype(int).tolist()
        cv2.circle(picture, centre, 13, white, 2, cv2.LINE_AA)
    text = f"{run.description.motion} {run.description.model}  {time:6.2f} s"
    cv2.putText(picture, text, (16, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.8, white, 2)
    return picture
