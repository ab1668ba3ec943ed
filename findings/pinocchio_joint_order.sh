#!/bin/sh
# Versions: pin 4.1.0, mujoco 4.0.0, yourdfpy 0.0.60
# Question: A URDF states the joints of three legs in the order leg1, leg2, leg10. In which order are they
#   in q?
# Guess: "In the order of the file, in all three libraries."
# True: MuJoCo and yourdfpy keep it. pinocchio sorts siblings by their name: leg1, leg10, leg2.
# Matters: Legs of a parallel robot are siblings. Recorded joints that are given as one array reach other
#   legs, and with equal legs the poses still look plausible. Address joints by their names.
cd "$(dirname "$0")" && ./with_packages pin==4.1.0 mujoco==4.0.0 yourdfpy==0.0.60 numpy==2.4.6 <<'END'
import mujoco
import pinocchio as pin
import yourdfpy

NAMES = ["leg1", "leg2", "leg10"]
text = '<robot name="r"><link name="base"/>' + "".join(
    f'<link name="body_{name}"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    f'<joint name="{name}" type="prismatic"><parent link="base"/><child link="body_{name}"/>'
    '<axis xyz="0 0 1"/><limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
    for name in NAMES
) + "</robot>"
with open("robot.urdf", "w") as file:
    file.write(text)
model = mujoco.MjModel.from_xml_string(text)
orders = {
    "MuJoCo": [model.joint(i).name for i in range(model.njnt)],
    "yourdfpy": [*yourdfpy.URDF.load("robot.urdf", load_meshes=False).actuated_joint_names],
    "pinocchio": [*pin.buildModelFromXML(text).names][1:],
}
for library, order in orders.items():
    print(library, order)
assert orders["MuJoCo"] == orders["yourdfpy"] == NAMES
assert orders["pinocchio"] == sorted(NAMES)
END
# Seen:
#   MuJoCo ['leg1', 'leg2', 'leg10']
#   yourdfpy ['leg1', 'leg2', 'leg10']
#   pinocchio ['leg1', 'leg10', 'leg2']
