#!/bin/sh
# Versions: opencv-python-headless 5.0.0.93 (4.13.0.92 does the same)
# Question: findChessboardCorners and findChessboardCornersSB see one image of a board with 8 x 5 corners.
#   Is the first corner the same?
# Guess: "Yes: both number row by row from the top left; SB is a more accurate replacement."
# True: They begin at opposite ends of the board, in whatever way it is turned in the image. An 8 x 5 board
#   looks different after half a turn, so both are consistent, each with itself.
# Matters: Replacing one by the other turns the board by half a turn about its centre. The camera calibrates
#   as well as before; the pose of the board on the robot, and every hand-eye result, is another one.
cd "$(dirname "$0")" && ./with_packages opencv-python-headless==5.0.0.93 numpy==2.4.6 <<'END'
import cv2
import numpy as np

SIZE = 40


def draw(columns, rows):
    image = np.full(((rows + 3) * SIZE, (columns + 3) * SIZE), 255, np.uint8)
    for j in range(rows + 1):
        for i in range(j % 2, columns + 1, 2):
            image[(j + 1) * SIZE : (j + 2) * SIZE, (i + 1) * SIZE : (i + 2) * SIZE] = 0
    return image


for shape in ((8, 5), (7, 6)):
    upright = draw(*shape)
    for name, image in (("upright", upright), ("half a turn", cv2.rotate(upright, cv2.ROTATE_180))):
        first, last = zip(*(
            np.reshape(find(image, shape)[1], (-1, 2))[[0, -1]]
            for find in (cv2.findChessboardCorners, cv2.findChessboardCornersSB)
        ))
        print(shape, name, *(f"{way} begins at {np.rint(corner)}" for way, corner in zip(("classic", "SB"), first)))
        assert np.linalg.norm(first[0] - last[1]) < 1
        assert np.linalg.norm(first[1] - last[0]) < 1
END
# Seen:
#   (8, 5) upright classic begins at [80. 80.] SB begins at [359. 239.]
#   (8, 5) half a turn classic begins at [360. 240.] SB begins at [79. 79.]
#   (7, 6) upright classic begins at [80. 80.] SB begins at [320. 280.]
#   (7, 6) half a turn classic begins at [320. 280.] SB begins at [80. 80.]
