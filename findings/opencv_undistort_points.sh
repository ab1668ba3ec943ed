#!/bin/sh
# Versions: opencv-python-headless 5.0.0.93 (4.13.0.92 does the same)
# Question: How exactly does undistortPoints invert projectPoints for a wide lens (k1 = -0.3, k2 = 0.1)?
# Guess: "To 1e-6 px or better: it iterates until it converges."
# True: It stops after five iterations. 0.14 px are left in the corner of the image, 0.0001 px near the
#   centre. With up to 100 iterations (argument `criteria`) it is exact.
# Matters: Corners are measured to 0.02 px. The error is a smooth function of the place in the image, and a
#   fit takes it for an error of the robot: 0.14 px at 1 m with a focal length of 1000 px are 0.14 mm.
cd "$(dirname "$0")" && ./with_packages opencv-python-headless==5.0.0.93 numpy==2.4.6 <<'END'
import cv2
import numpy as np

K = np.array([[1000.0, 0, 640], [0, 1000, 480], [0, 0, 1]])
lens = np.array([-0.3, 0.1, 0, 0, 0])
pixels = np.array([[[50.0, 50.0]], [[300.0, 300.0]]])


def error(rays):
    points = np.concatenate([rays, np.ones((2, 1, 1))], axis=2)
    again, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, lens)
    return np.linalg.norm(again - pixels, axis=2).ravel()


usual = error(cv2.undistortPoints(pixels, K, lens))
criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
more = error(cv2.undistortPoints(pixels, K, lens, R=None, P=None, criteria=criteria))
print("corner and centre, five iterations:", np.round(usual, 4), "px")
print("corner and centre, up to 100:", np.round(more, 9), "px")
assert 0.13 < usual[0] < 0.15
assert more.max() < 1e-6
END
# Seen:
#   corner and centre, five iterations: [1.411e-01 1.000e-04] px
#   corner and centre, up to 100: [0. 0.] px
