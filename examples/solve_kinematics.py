"""Where is the platform, which joint readings reach a pose, and how accurate is the answer?"""

import numpy as np

import parallel_cal as pc

model = pc.new_model("stewart42")
robot = pc.Kinematics(model)
home = model.mechanism.home

pose = robot.direct(home.joints)
print("platform [mm]:", np.round(1e3 * pose.position, 3) + 0.0)

target = pose.position + [0.01, 0.0, 0.02]
joints = robot.inverse(target, pose.rotation).joints
print("legs [mm]:", np.round(1e3 * joints, 3))

back = robot.direct(joints).position
print("there and back within 1 nm:", np.abs(back - target).max() < 1e-9)

# Prints:
# platform [mm]: [  0.   0. 300.]
# legs [mm]: [106.442 106.442 114.394 110.979 110.979 114.394]
# there and back within 1 nm: True
