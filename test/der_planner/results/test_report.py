"""The page, its figures, those over camera frames and the film, from runs and bags with images."""

import csv
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from runs import FRAMES, TIMES, BagOfRun, reference, series

from der_planner.bags.reader import BagReader
from der_planner.results import (
    EvaluationError,
    compare,
    evaluate_run,
    load_run,
    write_report,
)
from der_planner.results.figures import (
    COLUMN,
    colours_of,
    mean_error,
    paper_style,
    shared_legend,
)
from der_planner.results.overlay import plot_shapes, write_video
from der_planner.results.report import document
from der_planner.results.scenes import RunImages


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("filmed") / "run"
    run = FilmedRun(path, run=json.dumps({"trial": 1, "seed": 1, "commit": "c0ffee"}))
    run.plan()
    run.calibration()
    random = np.random.default_rng(2)
    for index, when in enumerate(FRAMES[FRAMES >= 0]):
        run.state(when, reference(when)[0] + np.array([0.0, 0.002]))
        if index % 10 == 0:
            run.frame(when, shade=index % 250)
            run.tags(when, random.uniform([0.0, -0.1], [0.24, 0.1], (5, 2)))
    for index in range(len(TIMES)):
        run.setpoint(index, [0.0, 0.0])
    run.bag.close()
    return path


def test_projection_is_found_from_the_tags_alone(bag: Path):
    with BagReader(bag) as reader:
        project = RunImages(reader, load_run(bag)).projection()
    points = np.random.default_rng(3).uniform([0.0, -0.1], [0.24, 0.1], (50, 2))
    assert np.abs(project(points) - pixels(points)).max() < 0.05
    assert project(np.empty((0, 2))).shape == (0, 2)


@pytest.mark.slow
def test_report_is_one_page_with_everything_in_it(bag: Path, tmp_path: Path):
    run = load_run(bag)
    other = series(reference(FRAMES) + np.array([0.0, 0.01]), model="pcc", trial=1, seed=1)
    results = [evaluate_run(run), evaluate_run(other)]
    written = write_report([run, other], results, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= {"results.json", "table.md", "table.csv", "table.tex", "report.html"}
    assert names >= {f"{n}.{e}" for n in ("tip", "error", "shapes") for e in ("png", "pdf")}
    page = written.read_text()
    sources = re.findall(r'(?:src|href|srcset)="([^"]*)"', page)
    assert sources
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert "url(" not in page
    assert "Errors &lt;of a lab&gt;" in document("Errors <of a lab>", [])
    assert "c0ffee" in page
    (found,) = compare(results)
    assert f"{found.difference_m * 100:.2f} cm less error" in page
    with (tmp_path / "table.csv").open() as file:
        rows = {row["model"]: float(row["mean_error_m"]) for row in csv.DictReader(file)}
    assert rows["der"] == pytest.approx(0.002, abs=5e-5)
    assert rows["pcc"] == pytest.approx(0.01, abs=5e-5)


def test_film_is_as_long_as_the_run(bag: Path, tmp_path: Path):
    """The states have the rate of a camera of which the bag lacks nine pictures of ten."""
    path = write_video(load_run(bag), tmp_path / "film.mp4")
    film = cv2.VideoCapture(str(path))
    count = 0
    while film.read()[0]:
        count += 1
    shown = FRAMES[FRAMES >= 0][::10]
    assert count == 10 * (len(shown) - 1) + 1
    assert count / film.get(cv2.CAP_PROP_FPS) == pytest.approx(shown[-1] - shown[0], abs=0.1)


def test_an_animated_picture_shows_the_motion_alone(bag: Path, tmp_path: Path):
    path = write_video(load_run(bag), tmp_path / "film.webp")
    _, film = cv2.imreadanimation(str(path))
    shown = FRAMES[FRAMES >= 0][::10]
    assert len(film.frames) == np.count_nonzero(shown <= TIMES[-1])
    assert film.frames[0].shape[:2] == (420, 560)


def test_pictures_that_are_stamped_late_show_the_limb_of_their_exposure(tmp_path: Path):
    run, late = FilmedRun(tmp_path / "late"), 0.07
    run.plan()
    run.calibration(np.zeros((3, 3)))
    for index, when in enumerate(FRAMES[FRAMES >= 0][:60]):
        jitter = 0.002 * (index % 7)
        point = run.make("geometry_msgs/msg/Point", x=float(index))
        run.write("/limb/state", "LimbState", when + jitter, valid=True, curve=[point], tip=point)
        run.frame(when + jitter + late, shade=index)
        run.tags(when + jitter, np.zeros((5, 2)))
    for index in range(len(TIMES)):
        run.setpoint(index, [0.0, 0.0])
    path = run.bag.close()
    with BagReader(path) as reader:
        images = RunImages(reader, load_run(path))
        shots = list(images.pictures())
        assert images.projection() is None, "the calibration is all zeros"
        assert images.snapshot(shots[30][0]).picture[0, 0] == 30
    assert [shot.measured[0, 0] for _, shot in shots] == [shot.picture[0, 0] for _, shot in shots]
    assert shots[1][0] == pytest.approx(FRAMES[FRAMES >= 0][1] + 0.002)


def test_bag_without_images_has_shapes_but_no_film(tmp_path: Path):
    loaded = load_run(BagOfRun(tmp_path / "plain").still_run())
    assert len(plot_shapes([loaded], tmp_path)) == 2
    with pytest.raises(EvaluationError, match="no camera calibration"):
        write_video(loaded, tmp_path / "film.mp4")
    assert plot_shapes([series(reference(FRAMES))], tmp_path) == []


CAMERA = np.array([[300.0, 0.0, 158.0], [0.0, 305.0, 121.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.12, 0.03, 0.001, -0.0005, 0.0])
ROTATION = np.array([0.05, 3.08, 0.1])
POSITION = np.array([0.1, 0.02, 0.55])
HEIGHT = 0.03


def pixels(points: np.ndarray) -> np.ndarray:
    """Project points (N, 2) [m] of the plane of the tags with OpenCV's camera model."""
    lifted = np.column_stack([points, np.full(len(points), HEIGHT)])
    return cv2.projectPoints(lifted, ROTATION, POSITION, CAMERA, DISTORTION)[0][:, 0, :]


TAGS = "der_msgs/msg/TagDetectionArray"


class FilmedRun(BagOfRun):
    """A run with camera and tags."""

    def __init__(self, folder: Path, **options) -> None:
        super().__init__(folder, types=(TAGS,), **options)

    def frame(self, seconds: float, shade: int) -> None:
        data = np.full(240 * 320, shade, dtype=np.uint8)
        about = {"height": 240, "width": 320, "encoding": "mono8", "step": 320}
        self.write("/limb/camera/image_raw", "sensor_msgs/msg/Image", seconds, data=data, **about)

    def calibration(self, matrix: np.ndarray = CAMERA) -> None:
        about = {"height": 240, "width": 320, "distortion_model": "plumb_bob"}
        name = "sensor_msgs/msg/CameraInfo"
        self.write("/limb/camera/camera_info", name, 0.0, d=DISTORTION, k=matrix.ravel(), **about)

    def tags(self, seconds: float, centres: np.ndarray) -> None:
        square = 0.01 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        detections = [
            self.make(
                "der_msgs/msg/TagDetection",
                id=i,
                corners=pixels(centre + square).ravel(),
                on_limb=True,
                pose_valid=True,
                pose=self.make("geometry_msgs/msg/Pose2D", x=centre[0], y=centre[1]),
            )
            for i, centre in enumerate(centres)
        ]
        self.write("/limb/tags", TAGS, seconds, detections=detections)


def test_mean_error_over_trials_ignores_gaps():
    one = series(reference(FRAMES) + np.array([0.0, 0.002]))
    tip = reference(FRAMES) + np.array([0.0, 0.006])
    tip[(FRAMES > 3.0) & (FRAMES < 4.0)] = np.nan
    two = series(tip, trial=1)
    time, mean, deviation = mean_error([one, two])
    both = (time < 2.8) | (time > 4.2)
    alone = (time > 3.2) & (time < 3.8)
    assert np.allclose(mean[both], 0.004, atol=5e-5)
    assert np.allclose(deviation[both], np.std([0.002, 0.006], ddof=1), atol=5e-5)
    assert np.allclose(mean[alone], 0.002, atol=5e-5)
    assert np.all(deviation[alone] == 0)


def test_methods_of_a_model_are_told_apart_in_a_legend_that_is_whole():
    runs = [series(reference(FRAMES), method=f"optimal, learned {n}") for n in range(5)]
    colours = colours_of(runs)
    assert len(set(colours.values())) == 5
    with paper_style():
        figure = Figure(figsize=(COLUMN, 2.2))
        axis = figure.subplots()
        for label, colour in colours.items():
            axis.plot([0.0, 1.0], color=colour, label=label)
        shared_legend(figure, [axis])
        figure.canvas.draw()
        drawn = figure.legends[0].get_window_extent()
        assert drawn.x0 >= 0.0
        assert drawn.x1 <= figure.bbox.x1
