"""Grey levels and lenses from the messages of a camera's driver, of rclpy or of rosbags."""

from __future__ import annotations

from typing import Any

import numpy as np

from parallel_cal.imaging.detection import Grey
from parallel_cal.imaging.opencv import ImageError, load_opencv

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

# Encodings of sensor_msgs/image_encodings.h: bytes per channel, channels, conversion of OpenCV.
ENCODINGS = {
    "mono8": (1, 1, ""),
    "8UC1": (1, 1, ""),
    "mono16": (2, 1, ""),
    "16UC1": (2, 1, ""),
    "rgb8": (1, 3, "COLOR_RGB2GRAY"),
    "bgr8": (1, 3, "COLOR_BGR2GRAY"),
    "8UC3": (1, 3, "COLOR_BGR2GRAY"),
    "rgba8": (1, 4, "COLOR_RGBA2GRAY"),
    "bgra8": (1, 4, "COLOR_BGRA2GRAY"),
    "bayer_rggb8": (1, 1, "COLOR_BayerBG2GRAY"),
    "bayer_bggr8": (1, 1, "COLOR_BayerRG2GRAY"),
    "bayer_gbrg8": (1, 1, "COLOR_BayerGR2GRAY"),
    "bayer_grbg8": (1, 1, "COLOR_BayerGB2GRAY"),
    "uyvy": (1, 2, "COLOR_YUV2GRAY_UYVY"),
    "yuv422": (1, 2, "COLOR_YUV2GRAY_UYVY"),
    "yuyv": (1, 2, "COLOR_YUV2GRAY_YUYV"),
    "yuv422_yuy2": (1, 2, "COLOR_YUV2GRAY_YUYV"),
}
MODELS = {"plumb_bob": "pinhole", "equidistant": "fisheye", "": "pinhole"}


def decode_image(message: Any) -> Grey:
    """Return the grey levels (h, w) of an Image or CompressedImage.

    ImageError for an encoding that has no grey levels, or for a damaged image.
    """
    cv2, content = load_opencv(), np.asarray(message.data, np.uint8)
    if hasattr(message, "format"):
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
        if image is None:
            raise ImageError(f"a compressed image ({message.format}) cannot be decoded")
        return np.asarray(image, np.uint8)
    if message.encoding not in ENCODINGS:
        raise ImageError(
            f"encoding {message.encoding}: expected one of {', '.join(ENCODINGS)}, or a "
            "CompressedImage"
        )
    size, channels, conversion = ENCODINGS[message.encoding]
    width, height, used = message.width, message.height, message.width * size * channels
    if len(content) < message.step * height or message.step < used:
        raise ImageError(
            f"an image of {width} x {height} px ({message.encoding}) has {len(content)} bytes, "
            f"expected {used * height}"
        )
    rows = content[: message.step * height].reshape(height, message.step)[:, :used]
    if size == 2:
        order = ">u2" if message.is_bigendian else "<u2"
        grey = np.ascontiguousarray(rows).view(order).astype(float)
        return np.asarray(255.0 * grey / max(float(grey.max()), 1.0), np.uint8)
    image = np.ascontiguousarray(rows.reshape(height, width, channels).squeeze())
    return np.asarray(cv2.cvtColor(image, getattr(cv2, conversion)) if conversion else image)


def describe_lens(info: Any) -> str:
    """Return the lens of a CameraInfo as options of the sensor `camera`; empty without one."""
    matrix = np.asarray(getattr(info, "k", ()), float).ravel()
    if matrix.size != 9 or matrix[0] == 0.0:
        return ""
    model = MODELS.get(info.distortion_model)
    lens = f"focal_length: [{matrix[0]:.8g}, {matrix[4]:.8g}], "
    lens += f"principal_point: [{matrix[2]:.8g}, {matrix[5]:.8g}]"
    if model is None:
        return lens  # a distortion with other formulas
    words = ", ".join(f"{value:.8g}" for value in np.asarray(info.d, float)[:5])
    return f"model: {model}, {lens}" + (f", distortion: [{words}]" if words else "")
