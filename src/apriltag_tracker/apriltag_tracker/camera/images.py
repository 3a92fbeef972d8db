"""Images: grey pixels of messages, and sources other than a topic.

A source is a V4L2 device, a video file or a folder of pictures. A device is read by its own thread,
so that a frame is stamped when it arrives and only the newest one waits. Files are played at a
steady rate by the clock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class _Encoding(NamedTuple):
    """How the pixels of an image message become grey.

    Attributes:
        width: bytes of a pixel.
        conversion: OpenCV's, None where the brightness is there.
        first: byte of the first pixel's brightness.
        wide: whether a pixel is a word of 16 bits.
    """

    width: int
    conversion: int | None = None
    first: int = 0
    wide: bool = False


# A pattern is named by its first row in ROS and by its second row, second column on, in OpenCV.
_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerBG2GRAY,
    "bayer_bggr": cv2.COLOR_BayerRG2GRAY,
    "bayer_gbrg": cv2.COLOR_BayerGR2GRAY,
    "bayer_grbg": cv2.COLOR_BayerGB2GRAY,
}
_ENCODINGS = {
    **dict.fromkeys(("mono8", "8UC1"), _Encoding(1)),
    **dict.fromkeys(("mono16", "16UC1"), _Encoding(2, wide=True)),
    "bgr8": _Encoding(3, cv2.COLOR_BGR2GRAY),
    "rgb8": _Encoding(3, cv2.COLOR_RGB2GRAY),
    "bgra8": _Encoding(4, cv2.COLOR_BGRA2GRAY),
    "rgba8": _Encoding(4, cv2.COLOR_RGBA2GRAY),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), _Encoding(2)),
    **dict.fromkeys(("yuv422", "uyvy"), _Encoding(2, first=1)),
    # A plane of brightness with half as many rows of colour below it, which are not read.
    **dict.fromkeys(("nv12", "nv21"), _Encoding(1)),
    **{f"{name}8": _Encoding(1, code) for name, code in _BAYER.items()},
    **{f"{name}16": _Encoding(2, code, wide=True) for name, code in _BAYER.items()},
}

PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"}


class ImageError(ValueError):
    """An image message cannot be read; the message says what came and what is expected."""


class ImageReader:
    """Reads the image messages of one camera.

    A camera of 10 or 12 bits sends them in words of 16, in the low or in the high bits. How many
    bits it has shows in the largest value so far, which therefore is remembered: an image that is
    darker than those before is dark.
    """

    def __init__(self) -> None:
        self._bits = 8

    def to_grey(
        self,
        data: Any,
        height: int,
        width: int,
        step: int,
        encoding: str,
        big_endian: bool = False,
    ) -> NDArray[np.uint8]:
        """Return the grey picture of an image message.

        Args:
            data: bytes of the message.
            height: rows.
            width: columns.
            step: bytes from row to row.
            encoding: as named by `sensor_msgs/image_encodings`.
            big_endian: of 16-bit pixels.

        Raises:
            ImageError: unknown encoding, or fewer bytes than the size needs.
        """
        if encoding not in _ENCODINGS:
            raise ImageError(f"unknown encoding '{encoding}': {', '.join(_ENCODINGS)} are read")
        known = _ENCODINGS[encoding]
        row = width * known.width
        raw = np.frombuffer(data, dtype=np.uint8)
        if height <= 0 or width <= 0 or step < row or raw.size < step * height:
            raise ImageError(
                f"image of {width} x {height} px in {encoding} with {step} bytes a row has "
                f"{raw.size} bytes: {row} bytes a row or more expected"
            )
        pixels = np.ascontiguousarray(raw[: step * height].reshape(height, step)[:, :row])
        if known.wide:
            pixels = self._from_16_bits(pixels.view(">u2" if big_endian else "<u2"))
        elif known.conversion is None:
            return np.ascontiguousarray(pixels[:, known.first :: known.width])
        if known.conversion is None:
            return pixels
        pixels = pixels.reshape(height, width, -1)
        return np.asarray(cv2.cvtColor(pixels, known.conversion), dtype=np.uint8)

    def _from_16_bits(self, words: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the upper 8 of as many bits as the camera has shown to use, 8 to 16."""
        used = int(words.max()).bit_length()
        self._bits = max(self._bits, min(2 * -(-used // 2), 16))
        return np.ascontiguousarray(words >> (self._bits - 8), dtype=np.uint8)


def to_grey(
    data: Any, height: int, width: int, step: int, encoding: str, big_endian: bool = False
) -> NDArray[np.uint8]:
    """Return the grey picture of one image message by itself, see `ImageReader.to_grey`."""
    return ImageReader().to_grey(data, height, width, step, encoding, big_endian)


def check_grey(image: Any) -> NDArray[np.uint8]:
    """Check an image and return it as contiguous grey.

    Raises:
        ValueError: not an array of uint8 with one or three channels.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in {2, 3}:
        what = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image)
        raise ValueError(
            f"image: uint8 array (rows, columns) or (rows, columns, 3) expected, not {what}"
        )
    if image.size == 0:
        raise ValueError(f"image: the picture is empty ({image.shape[1]} x {image.shape[0]} px)")
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return np.ascontiguousarray(image)


class SourceError(RuntimeError):
    """No image can be had from a source; the message names it and the remedy."""


@dataclass(frozen=True)
class Grabbed:
    """A grey picture and when it was taken [ns since the epoch]."""

    gray: NDArray[np.uint8]
    stamp: int


def open_source(
    name: str,
    rate: float,
    clock: Callable[[], int] = time.time_ns,
    size: tuple[int, int] | None = None,
) -> Source:
    """Open a source by its name.

    Args:
        name: /dev/videoN or a number, a video file, or a folder.
        rate: images a second, for a folder and as a wish to a device.
        clock: nanoseconds since the epoch.
        size: width and height to ask a device for [px], those of its calibration.

    Raises:
        SourceError: there is no such thing, or it cannot be opened.
    """
    path = Path(name)
    if name.isdigit() or name.startswith("/dev/"):
        return DeviceSource(name, rate, clock, size=size)
    if path.is_dir():
        return FolderSource(path, rate, clock)
    if path.is_file():
        return VideoSource(path, clock)
    raise SourceError(
        f"source '{name}': 'topic', /dev/videoN, a video file or a folder of images expected"
    )


class _Pace:
    """Says when the next picture is due; one that comes late does not hurry the others."""

    def __init__(self, period: int) -> None:
        self._period = period
        self._due: int | None = None

    def is_due(self, now: int) -> bool:
        """Tell whether a picture is due, and if so, plan the next."""
        if self._due is not None and now < self._due:
            return False
        late = self._due is not None and now - self._due < self._period
        start = self._due if late and self._due is not None else now
        self._due = start + self._period
        return True


class FolderSource:
    """Plays the pictures of a folder in the order of their names."""

    def __init__(self, folder: Path, rate: float, clock: Callable[[], int]) -> None:
        self._files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
        if not self._files:
            raise SourceError(f"no picture ({', '.join(sorted(PICTURES))}) in {folder}")
        self._folder = folder
        self._pace = _Pace(round(1e9 / rate))
        self._clock = clock
        self._next = 0

    def read(self) -> Grabbed | None:
        """Return the next picture once it is due."""
        if self._next >= len(self._files):
            raise SourceError(f"the {len(self._files)} pictures of {self._folder} have been played")
        now = self._clock()
        if not self._pace.is_due(now):
            return None
        path = self._files[self._next]
        self._next += 1
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SourceError(f"{path} is no picture that OpenCV reads")
        return Grabbed(np.asarray(image, dtype=np.uint8), now)

    def close(self) -> None:
        """Nothing to release."""


class VideoSource:
    """Plays a video file at its own rate."""

    def __init__(self, path: Path, clock: Callable[[], int]) -> None:
        self._video = cv2.VideoCapture(str(path))
        if not self._video.isOpened():
            raise SourceError(f"{path} is no video that OpenCV reads")
        self._path = path
        rate = float(self._video.get(cv2.CAP_PROP_FPS))
        self._pace = _Pace(round(1e9 / (rate if 0.1 < rate < 1000.0 else 30.0)))
        self._clock = clock

    def read(self) -> Grabbed | None:
        """Return the next frame once it is due."""
        now = self._clock()
        if not self._pace.is_due(now):
            return None
        found, image = self._video.read()
        if not found:
            raise SourceError(f"the video {self._path} has been played")
        return Grabbed(check_grey(image), now)

    def close(self) -> None:
        """Release the file."""
        self._video.release()


class DeviceSource:
    """A V4L2 camera, read by a thread; opened again when it was unplugged."""

    _RETRY = 1.0

    def __init__(
        self,
        name: str,
        rate: float,
        clock: Callable[[], int],
        capture: Callable[[str], Any] | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self._name = name
        self._rate = rate
        self._clock = clock
        self._size = size
        self._capture = capture or _open_device
        self._video = self._open()
        if not self._video.isOpened():
            raise SourceError(
                f"cannot open the camera {name}: is it plugged in, free, and may you read it "
                "(group video)?"
            )
        self._newest: Grabbed | None = None
        self._problem = ""
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def read(self) -> Grabbed | None:
        """Return the newest frame once; raises `SourceError` while the camera is gone."""
        with self._lock:
            if self._problem:
                raise SourceError(self._problem)
            newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """Stop the thread and release the camera."""
        self._stop.set()
        self._thread.join(timeout=3.0)
        self._video.release()

    def _open(self) -> Any:
        video = self._capture(self._name)
        if self._size is not None:
            video.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
        video.set(cv2.CAP_PROP_FPS, self._rate)
        return video

    def _run(self) -> None:
        while not self._stop.is_set():
            found, image = self._video.read()
            stamp = self._clock()
            if found:
                grabbed = Grabbed(check_grey(image), stamp)
                with self._lock:
                    self._newest, self._problem = grabbed, ""
                continue
            with self._lock:
                self._newest = None
                self._problem = f"the camera {self._name} gives no images: was it unplugged?"
            self._stop.wait(self._RETRY)
            if not self._stop.is_set():
                self._video.release()
                self._video = self._open()


Source = FolderSource | VideoSource | DeviceSource
"""Something that gives images."""


def _open_device(name: str) -> Any:
    device = int(name) if name.isdigit() else name
    return cv2.VideoCapture(device, cv2.CAP_V4L2)
