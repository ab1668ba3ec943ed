"""Draw the corners that were detected into an image."""

from __future__ import annotations

from typing import Any

import numpy as np

from parallel_cal.imaging.detection import Corners, Grey
from parallel_cal.imaging.opencv import ImageError, load_opencv

USED, UNUSABLE = (80, 200, 0), (0, 60, 230)  # blue, green, red
RADIUS_PX, THICKNESS_PX = 7, 2
JPEG_QUALITY = 80


def draw_corners(image: Grey, corners: Corners) -> bytes:
    """Return an image (h, w) as JPEG, with a circle around each corner, and why it is not used."""
    cv2 = load_opencv()
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    colour = UNUSABLE if corners.problem else USED
    for pixel in np.round(corners.pixels).astype(int).tolist():
        cv2.circle(drawn, pixel, RADIUS_PX, colour, THICKNESS_PX, cv2.LINE_AA)
    if corners.problem:
        at = (10, image.shape[0] - 15)
        cv2.putText(drawn, corners.problem, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, UNUSABLE, 2)
    return encode_jpeg(drawn, JPEG_QUALITY)


def encode_jpeg(image: Any, quality: int) -> bytes:
    """Return an image (h, w) or (h, w, 3) as JPEG of a quality from 0 to 100."""
    cv2 = load_opencv()
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ImageError(f"an image of shape {np.shape(image)} cannot be written as JPEG")
    return bytes(jpeg)
