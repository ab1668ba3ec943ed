"""OpenCV, which is needed only to draw boards and to detect them."""

from __future__ import annotations

from typing import Any

from parallel_cal.base.errors import ParallelCalError

CURE = "pip install 'parallel_cal[camera]'"


class ImageError(ParallelCalError):
    """A board cannot be drawn, or images cannot be read or used."""


def load_opencv() -> Any:
    """Import OpenCV; ImageError says how to install it."""
    try:
        import cv2

        cv2.aruco.CharucoBoard.setLegacyPattern  # noqa: B018  # OpenCV 4.7 and older lack it
    except ImportError:
        raise ImageError(f"boards and images need OpenCV, which is not installed: {CURE}") from None
    except AttributeError:
        raise ImageError(
            f"OpenCV {cv2.__version__} is too old for ChArUco boards, expected 4.8 or newer: {CURE}"
        ) from None
    return cv2
