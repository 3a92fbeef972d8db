"""Images: grey pixels of messages, and sources other than a topic.

A source is a V4L2 device, a video file or a folder of pictures. A device is read by its own thread,
so that a frame is stamped when it arrives and only the newest one waits. Files are played at a
steady rate by the clock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
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
    """No image can be had; the message says from what, and what is expected or the remedy."""


class ImageReader:
    """Reads the image messages of one camera.

    A camera of 10 or 12 bits sends them in words of 16, in the low or in the high bits. How many
    bits it has shows in the largest value so far, which therefore is remembered: an image that is
    darker than those before is dark.
    """

    def __init__(self) -> None:
        self._bits = 8

    def to_grey(self, message: Any) -> NDArray[np.uint8]:
        """Return the grey picture of a `sensor_msgs/Image`.

        Raises:
            ImageError: unknown encoding, or fewer bytes than the size needs.
        """
        height, width, step = message.height, message.width, message.step
        encoding = message.encoding
        if encoding not in _ENCODINGS:
            raise ImageError(f"unknown encoding '{encoding}': {', '.join(_ENCODINGS)} are read")
        known = _ENCODINGS[encoding]
        row = width * known.width
        raw = np.frombuffer(message.data, dtype=np.uint8)
        if height <= 0 or width <= 0 or step < row or raw.size < step * height:
            raise ImageError(
                f"image of {width} x {height} px in {encoding} with {step} bytes a row has "
                f"{raw.size} bytes: {row} bytes a row or more expected"
            )
        pixels = np.ascontiguousarray(raw[: step * height].reshape(height, step)[:, :row])
        if known.wide:
            pixels = self._from_16_bits(pixels.view(">u2" if message.is_bigendian else "<u2"))
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
        ImageError: there is no such thing, or it cannot be opened.
    """
    path = Path(name)
    if name.isdigit() or name.startswith("/dev/"):
        return DeviceSource(name, rate, clock, size)
    if path.is_dir():
        return _folder_source(path, rate, clock)
    if path.is_file():
        return _video_source(path, clock)
    raise ImageError(
        f"source '{name}': 'topic', /dev/videoN, a video file or a folder of images expected"
    )


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Read the file of a picture as grey.

    Raises:
        ImageError: OpenCV cannot read it.
    """
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ImageError(f"{path} is no picture that OpenCV reads")
    return np.asarray(image, dtype=np.uint8)


class FileSource:
    """Plays pictures at a steady rate; one that comes late does not hurry the others.

    Args:
        pictures: one after the other.
        rate: images a second.
        clock: nanoseconds since the epoch.
        ended: what to say when all have been played.
    """

    def __init__(
        self,
        pictures: Iterator[NDArray[np.uint8]],
        rate: float,
        clock: Callable[[], int],
        ended: str,
    ) -> None:
        self._pictures = pictures
        self._period = round(1e9 / rate)
        self._clock = clock
        self._ended = ended
        self._due = 0

    def read(self) -> Grabbed | None:
        """Return the next picture once it is due."""
        now = self._clock()
        if now < self._due:
            return None
        start = self._due if now - self._due < self._period else now
        self._due = start + self._period
        picture = next(self._pictures, None)
        if picture is None:
            raise ImageError(self._ended)
        return Grabbed(picture, now)

    def close(self) -> None:
        """Nothing to release."""


def _folder_source(folder: Path, rate: float, clock: Callable[[], int]) -> FileSource:
    """Play the pictures of a folder in the order of their names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    if not files:
        raise ImageError(f"no picture ({', '.join(sorted(PICTURES))}) in {folder}")
    ended = f"the {len(files)} pictures of {folder} have been played"
    return FileSource(map(read_picture, files), rate, clock, ended)


def _video_source(path: Path, clock: Callable[[], int]) -> FileSource:
    """Play a video file at its own rate."""
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise ImageError(f"{path} is no video that OpenCV reads")
    rate = float(video.get(cv2.CAP_PROP_FPS))
    rate = rate if 0.1 < rate < 1000.0 else 30.0
    return FileSource(_frames(video), rate, clock, f"the video {path} has been played")


def _frames(video: Any) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a video that is open."""
    while True:
        found, image = video.read()
        if not found:
            return
        yield check_grey(image)


class DeviceSource:
    """A V4L2 camera, read by a thread; opened again when it was unplugged."""

    _RETRY = 1.0

    def __init__(
        self,
        name: str,
        rate: float,
        clock: Callable[[], int],
        size: tuple[int, int] | None = None,
    ) -> None:
        self._name = name
        self._rate = rate
        self._clock = clock
        self._size = size
        self._video = self._open()
        if not self._video.isOpened():
            raise ImageError(
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
        """Return the newest frame once; raises `ImageError` while the camera is gone."""
        with self._lock:
            if self._problem:
                raise ImageError(self._problem)
            newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """Stop the thread and release the camera."""
        self._stop.set()
        self._thread.join(timeout=3.0)
        self._video.release()

    def _open(self) -> Any:
        video = _open_device(self._name)
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


Source = FileSource | DeviceSource
"""Something that gives images."""


def _open_device(name: str) -> Any:
    device = int(name) if name.isdigit() else name
    return cv2.VideoCapture(device, cv2.CAP_V4L2)
