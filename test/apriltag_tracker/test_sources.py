from __future__ import annotations

import array
import threading
import time

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import Image
from waiting import Clock, wait_for

from apriltag_tracker.camera import images
from apriltag_tracker.camera.images import (
    DeviceSource,
    ImageError,
    ImageReader,
    open_source,
)


def to_grey(data, height, width, step, encoding, big_endian=False, reader=None):
    """Return the grey picture of a message, read by a new reader if none is given."""
    message = Image(
        height=height, width=width, step=step, encoding=encoding, is_bigendian=big_endian
    )
    message.data = array.array("B", data)
    return (reader or ImageReader()).to_grey(message)


@pytest.fixture
def picture():
    return np.random.default_rng(0).integers(0, 256, (48, 64), dtype=np.uint8)


def _pairs(picture, swapped=False):
    pairs = np.stack([picture, np.full_like(picture, 128)], axis=-1)
    return pairs[..., ::-1] if swapped else pairs


def _with_colour(picture):
    return np.vstack([picture, np.full((24, 64), 128, dtype=np.uint8)])


@pytest.mark.parametrize(
    ("encoding", "rows", "big_endian"),
    [
        ("mono8", lambda picture: np.pad(picture, ((0, 0), (0, 16))), False),
        ("8UC1", lambda picture: picture, False),
        ("mono16", lambda picture: (picture.astype("<u2") << 8 | 0x55).astype("<u2"), False),
        ("mono16", lambda picture: (picture.astype("<u2") << 8 | 0x55).astype(">u2"), True),
        ("nv12", _with_colour, False),
        ("nv21", _with_colour, False),
        ("yuv422_yuy2", _pairs, False),
        ("uyvy", lambda picture: _pairs(picture, swapped=True), False),
    ],
)
def test_brightness_is_kept_and_padding_dropped(picture, encoding, rows, big_endian):
    data = np.ascontiguousarray(rows(picture))
    row = data[0].nbytes
    assert np.array_equal(to_grey(data.tobytes(), 48, 64, row, encoding, big_endian), picture)


@pytest.mark.parametrize("shift", [2, 4, 6])
def test_cameras_of_fewer_bits_than_their_words_are_as_bright_and_stay_so(picture, shift):
    picture[0, 0] = 255
    reader, words = ImageReader(), picture.astype("<u2") << shift
    darker = (words >> 3).tobytes()
    assert np.array_equal(to_grey(words.tobytes(), 48, 64, 128, "mono16", reader=reader), picture)
    assert np.array_equal(to_grey(darker, 48, 64, 128, "mono16", reader=reader), picture >> 3)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("first", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_the_grey_of_their_colours(first, wide):
    colours = {"r": 200, "g": 120, "b": 40}
    tile = np.array([colours[letter] for letter in first], dtype=np.uint16).reshape(2, 2)
    mosaic = np.tile(tile, (24, 32))
    data = (mosaic << 8 | 0xFF).astype("<u2") if wide else mosaic.astype(np.uint8)
    name = f"bayer_{first}{16 if wide else 8}"
    grey = to_grey(data.tobytes(), 48, 64, 128 if wide else 64, name)
    expected = round(0.299 * 200 + 0.587 * 120 + 0.114 * 40)
    assert np.abs(grey[2:-2, 2:-2].astype(int) - expected).max() <= 1


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("bgr8", [0, 1, 2]), ("rgb8", [2, 1, 0]), ("bgra8", [0, 1, 2, 0]), ("rgba8", [2, 1, 0, 0])],
)
def test_colours_become_the_same_grey(encoding, order):
    colours = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    data = np.ascontiguousarray(colours[:, :, order])
    grey = to_grey(data.tobytes(), 48, 64, 64 * len(order), encoding)
    assert np.array_equal(grey, cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((b"x" * 3072, 48, 64, 64, "yuv422p"), "unknown encoding 'yuv422p'"),
        ((b"x" * 100, 48, 64, 64, "mono8"), "100 bytes"),
        ((b"x" * 3072, 48, 64, 60, "mono8"), "60 bytes a row"),
        ((b"", 0, 0, 0, "mono8"), "0 x 0"),
    ],
)
def test_broken_messages_are_refused(arguments, message):
    with pytest.raises(ImageError, match=message):
        to_grey(*arguments)


def test_a_folder_is_played_in_order_at_its_rate(tmp_path, picture):
    for k in (2, 0, 1):
        cv2.imwrite(str(tmp_path / f"{k}.png"), picture // (k + 1))
    (tmp_path / "notes.txt").write_text("no picture")
    clock = Clock(1_000_000_000)
    source = open_source(str(tmp_path), 10.0, clock)
    stamps = []
    for k in range(3):
        grabbed = source.read()
        assert np.array_equal(grabbed.gray, picture // (k + 1))
        stamps.append(grabbed.stamp)
        clock.now += 50_000_000
        assert source.read() is None
        clock.now += 50_000_000
    assert np.diff(stamps).tolist() == [100_000_000] * 2
    with pytest.raises(ImageError, match="have been played"):
        source.read()


def test_a_video_is_played_to_its_end(tmp_path, picture):
    path = tmp_path / "run.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 20.0, (64, 48), False)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no video")
    for _ in range(3):
        writer.write(picture)
    writer.release()
    clock = Clock(1_000_000_000)
    source = open_source(str(path), 30.0, clock)
    for _ in range(3):
        assert source.read().gray.shape == (48, 64)
        clock.now += 50_000_000
    with pytest.raises(ImageError, match="has been played"):
        source.read()
    source.close()


@pytest.mark.parametrize("name", ["nowhere.avi", "/dev/video77", "folder"])
def test_sources_that_are_not_there_are_named(tmp_path, name):
    (tmp_path / "folder").mkdir()
    path = name if name.startswith("/dev") else str(tmp_path / name)
    with pytest.raises(ImageError, match=r"nowhere|video77|no picture"):
        open_source(path, 30.0)


class FakeCamera:
    """A V4L2 camera that can be unplugged."""

    def __init__(self):
        self.plugged = threading.Event()
        self.plugged.set()
        self.image = np.full((48, 64, 3), 100, np.uint8)

    def isOpened(self):
        return self.plugged.is_set()

    def set(self, *_):
        return True

    def read(self):
        time.sleep(0.002)
        return (True, self.image.copy()) if self.plugged.is_set() else (False, None)

    def release(self):
        pass


def test_an_unplugged_camera_is_named_and_comes_back(monkeypatch):
    camera = FakeCamera()
    monkeypatch.setattr(DeviceSource, "_RETRY", 0.01)
    monkeypatch.setattr(images, "_open_device", lambda _: camera)
    source = DeviceSource("/dev/video0", 30.0, time.time_ns)

    def gone():
        try:
            source.read()
        except ImageError as error:
            return "unplugged" in str(error)
        return False

    def there():
        try:
            return source.read() is not None
        except ImageError:
            return False

    try:
        wait_for(there, "a picture")
        camera.plugged.clear()
        wait_for(gone, "the error")
        # A frame from before is never given again.
        assert gone()
        camera.plugged.set()
        wait_for(there, "a picture")
    finally:
        source.close()
