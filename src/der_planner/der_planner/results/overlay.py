"""Measured and planned limbs over the camera's frames: as a figure, and as a film.

The projection from the limb's plane to the image is fitted to the tags in the bag itself: the
tracker recorded where each limb tag is in pixels and in `limb_base`, and the camera's calibration
is in the bag, so no file of the rig is needed. What lies in the plane of the limb tags projects
exactly.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from der_planner.arrays import Array, points_of
from der_planner.bags.reader import BagReader
from der_planner.bags.record import (
    NANOSECONDS,
    STATE_TYPE,
    TRUTH_SUFFIX,
    header_stamp,
)
from der_planner.bags.run import EvaluationError, RunSeries
from der_planner.results.figures import (
    CM,
    DASHES,
    PAGE,
    REFERENCE,
    by_motion,
    colour,
    paper_style,
    save,
    shared_legend,
)

INSTANTS = 5
"""Pictures in a row of the figure."""
IMAGE_TYPE = "sensor_msgs/msg/Image"
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"
TAGS_TYPE = "der_msgs/msg/TagDetectionArray"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"
LIMB_MARKER = "planner/limb"
"""Namespace of the marker that shows the planner's reference limb."""
MINIMUM_TAGS = 20
"""Least number of seen limb tags that a projection is fitted to."""
FITTED = 60.0
"""The projection is fitted to the tags of the first part of a run of this length [s]."""
DELAYED = 5.0
"""The delay of pictures is found in the first part of a run of this length [s]."""
TOGETHER = 0.015
"""A picture and a measured limb within this time are of one instant [s]: half a frame."""
NEAR = 0.5
"""Messages within this time of an instant may belong to it [s]."""

ANIMATION_WIDTH = 560
"""Of an animated picture [px]."""
ANIMATION_STEP = 0.15
"""From one of its frames to the next [s]."""
ANIMATION_QUALITY = 45
"""Of 100."""

Picture = NDArray[np.uint8]
Frames = Iterator[tuple[float, Picture]]
"""Times [s] and pictures of a film."""
_NOTHING = np.empty((0, 2))


@dataclass(frozen=True)
class Projection:
    """From the plane of the limb's tags to pixels.

    Attributes:
        homography: (3, 3) from metres to normalised, undistorted image coordinates.
        camera: (3, 3) intrinsic matrix [px].
        distortion: coefficients of ``plumb_bob``.
    """

    homography: Array
    camera: Array
    distortion: Array

    def __call__(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 2) [m]."""
        if not len(points):
            return _NOTHING
        lifted = np.column_stack([points, np.ones(len(points))]) @ self.homography.T
        rays = np.column_stack([lifted[:, :2] / lifted[:, 2:], np.ones(len(points))])
        pixels, _ = cv2.projectPoints(
            rays[:, None, :], np.zeros(3), np.zeros(3), self.camera, self.distortion
        )
        return np.asarray(pixels[:, 0, :], dtype=float)


class Snapshot(NamedTuple):
    """The limb at one instant.

    Attributes:
        picture: (H, W) gray image nearest in time, or None where the bag has no images.
        measured: (N, 2) curve of the tracker [m], empty where it had none.
        planned: (N, 2) curve of the planner's reference limb [m], empty where it published none.
    """

    picture: Picture | None
    measured: Array
    planned: Array


class RunImages:
    """What a bag shows of one run.

    Args:
        bag: open.
        run: of this bag.
    """

    def __init__(self, bag: BagReader, run: RunSeries) -> None:
        self._bag = bag
        self._origin = run.origin
        self._topics = {
            type_name: _topics_of(bag, type_name, run.description.namespace)[:1]
            for type_name in (IMAGE_TYPE, CAMERA_TYPE, TAGS_TYPE, STATE_TYPE, MARKERS_TYPE)
        }
        self._late = self._delay()

    def _delay(self) -> int:
        """Return by how much pictures are stamped later than their states, which are right [ns]."""
        last = self._origin + round(DELAYED * NANOSECONDS)
        images, states = (
            [header_stamp(message) for _, _, message in self._bag.messages(topics, None, last)]
            for topics in (self._topics[IMAGE_TYPE], self._topics[STATE_TYPE])
        )
        # The tracker takes the same time off every stamp.
        gaps = Counter(image - state for image in images for state in states)
        return max(gaps, key=lambda gap: (gaps[gap], -abs(gap)), default=0)

    def projection(self) -> Projection | None:
        """Fit the projection; None without a calibration or with too few tags."""
        info, pixels, plane = None, [], []
        wanted = self._topics[CAMERA_TYPE] + self._topics[TAGS_TYPE]
        last = self._origin + round(FITTED * NANOSECONDS)
        for topic, _, message in self._bag.messages(wanted, None, last):
            if topic in self._topics[CAMERA_TYPE]:
                info = message
                continue
            for tag in message.detections:
                if tag.on_limb and tag.pose_valid:
                    pixels.append(np.asarray(tag.corners).reshape(4, 2).mean(axis=0))
                    plane.append((tag.pose.x, tag.pose.y))
        # A camera that is not calibrated tells zeros.
        if info is None or not np.any(info.k) or len(pixels) < MINIMUM_TAGS:
            return None
        camera, distortion = np.array(info.k).reshape(3, 3), np.array(info.d)
        normal = cv2.undistortPoints(np.array(pixels)[:, None, :], camera, distortion)[:, 0, :]
        homography, _ = cv2.findHomography(np.array(plane), normal, 0)
        if homography is None:
            return None
        return Projection(np.asarray(homography), camera, distortion)

    def snapshot(self, time: float) -> Snapshot:
        """Return what is nearest to an instant, of each kind.

        Args:
            time: [s] since the first setpoint.
        """
        when, near = self._origin + round(time * NANOSECONDS), round(NEAR * NANOSECONDS)
        late = when + self._late
        read = self._bag.messages(self._topics[IMAGE_TYPE], late - near, late + near)
        images = [message for _, _, message in read]
        image = min(images, key=lambda each: abs(header_stamp(each) - late), default=None)
        picture = None if image is None else gray(image)
        curves = self._curves(when - near, when + near)
        return Snapshot(picture, *(_nearest_curve(each, when, NEAR) for each in curves))

    def pictures(self) -> Iterator[tuple[float, Snapshot]]:
        """Yield the limb at each picture, with the time [s] since the first setpoint.

        Pictures of an encoding that is not known are left out.
        """
        measured, planned = self._curves()
        for _, _, message in self._bag.messages(self._topics[IMAGE_TYPE]):
            picture, stamp = gray(message), header_stamp(message) - self._late
            if picture is not None:
                time = (stamp - self._origin) / NANOSECONDS
                seen = _nearest_curve(measured, stamp, TOGETHER)
                yield time, Snapshot(picture, seen, _nearest_curve(planned, stamp, NEAR))

    def _curves(
        self, start: int | None = None, stop: int | None = None
    ) -> tuple[dict[int, Array], dict[int, Array]]:
        """Return the measured and the planned limb by stamp, logged between two times [ns]."""
        measured = {
            header_stamp(message): points_of(message.curve if message.valid else [])
            for _, _, message in self._bag.messages(self._topics[STATE_TYPE], start, stop)
        }
        planned = {
            header_stamp(marker): points_of(marker.points)
            for _, _, message in self._bag.messages(self._topics[MARKERS_TYPE], start, stop)
            for marker in message.markers
            if marker.ns == LIMB_MARKER
        }
        return measured, planned


def _nearest_curve(curves: dict[int, Array], stamp: int, within: float) -> Array:
    """Return the curve nearest to a stamp [ns], an empty one if none is within some s."""
    near = min(curves, key=lambda each: abs(each - stamp), default=0)
    return curves[near] if abs(near - stamp) < within * NANOSECONDS else _NOTHING


def _topics_of(bag: BagReader, type_name: str, namespace: str) -> list[str]:
    """Return the topics of a type, neither simulated truth nor drawings.

    They are those of the limb's namespace, if there are any: a camera of the rig may have a name of
    its own.
    """
    named = [
        each.name
        for each in bag.topics.values()
        if each.type_name == type_name and not each.name.endswith((TRUTH_SUFFIX, "image_annotated"))
    ]
    return [name for name in named if name.startswith(f"{namespace.rstrip('/')}/")] or named


def gray(image: Any) -> Picture | None:
    """Return an image message as (H, W) gray values, None for an encoding that is not known."""
    # Only who looks at pictures needs the tracker.
    from apriltag_tracker.camera.images import ImageError, ImageReader  # noqa: PLC0415

    try:
        return ImageReader().to_grey(image)
    except ImageError:
        return None


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
                f"{path_of_bag}: no images of a known encoding; record them with "
                "record_images:=true"
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
        asked = run.reference.at(np.array([time]))
        centre = np.rint(project(asked))[0].astype(int).tolist()
        cv2.circle(picture, centre, 13, white, 2, cv2.LINE_AA)
    text = f"{run.description.motion} {run.description.model}  {time:6.2f} s"
    cv2.putText(picture, text, (16, 32), cv2.FONT_HERSHEY_SIMPLEX, 0.8, white, 2)
    return picture
