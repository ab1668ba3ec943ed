#!/bin/sh
# Versions: yourdfpy 0.0.60, ikpy 4.2.1, pin 4.1.0, mujoco 4.0.0
# Question: A URDF has a joint with <axis xyz="0 0 2"/>. Where is the tip for a joint value of 0.5?
# Guess: "Every loader normalizes the axis: 0.5 m along z, or 0.5 rad about z."
# True: pinocchio and MuJoCo do. A slider moves 1.0 m in yourdfpy and in ikpy. A hinge of ikpy is no
#   rotation at all: the tip leaves its circle (0.8776, 0.9589). yourdfpy normalizes the axis of a hinge.
# Matters: Axes that a CAD exporter or a fit wrote are seldom of length 1. An error of 1 % in the length of
#   an axis is 1 % of the travel in two of four loaders, which looks like a wrong pitch of the screw.
cd "$(dirname "$0")" && ./with_packages yourdfpy==0.0.60 ikpy==4.2.1 pin==4.1.0 mujoco==4.0.0 numpy==2.4.6 <<'END'
import warnings

import ikpy.chain
import mujoco
import numpy as np
import pinocchio as pin
import yourdfpy

warnings.simplefilter("ignore")
INERTIAL = (
    '<inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


def urdf(kind):
    return (
        f'<robot name="r"><mujoco><compiler fusestatic="false"/></mujoco><link name="base"/>'
        f'<link name="arm">{INERTIAL}</link><link name="tip">{INERTIAL}</link>'
        f'<joint name="j" type="{kind}"><parent link="base"/><child link="arm"/><axis xyz="0 0 2"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        '<joint name="f" type="fixed"><parent link="arm"/><child link="tip"/>'
        '<origin xyz="1 0 0"/></joint></robot>'
    )


def tips(kind, q):
    with open("robot.urdf", "w") as file:
        file.write(urdf(kind))
    robot = yourdfpy.URDF.load("robot.urdf", load_meshes=False)
    robot.update_cfg([q])
    yield "yourdfpy", robot.get_transform("tip", "base")[:3, 3]
    chain = ikpy.chain.Chain.from_urdf_file("robot.urdf", base_elements=["base"])
    yield "ikpy", chain.forward_kinematics([0, q, 0])[:3, 3]
    model = pin.buildModelFromXML(urdf(kind))
    data = model.createData()
    pin.framesForwardKinematics(model, data, np.array([q]))
    yield "pinocchio", data.oMf[model.getFrameId("tip")].translation
    model = mujoco.MjModel.from_xml_string(urdf(kind))
    data = mujoco.MjData(model)
    data.qpos[0] = q
    mujoco.mj_kinematics(model, data)
    yield "MuJoCo", data.body("tip").xpos


slider, turned = np.array([1, 0, 0.5]), np.array([np.cos(0.5), np.sin(0.5), 0])
expected = {
    "prismatic": {"yourdfpy": [1, 0, 1], "ikpy": [1, 0, 1], "pinocchio": slider, "MuJoCo": slider},
    "revolute": {
        "yourdfpy": turned, "ikpy": turned * [1, 2, 1], "pinocchio": turned, "MuJoCo": turned
    },
}
for kind, by_loader in expected.items():
    for loader, tip in tips(kind, 0.5):
        print(f"{kind:9} {loader:9} tip at", np.round(tip, 4) + 0.0)
        np.testing.assert_allclose(tip, by_loader[loader], atol=1e-9)
END
# Seen:
#   prismatic yourdfpy  tip at [1. 0. 1.]
#   prismatic ikpy      tip at [1. 0. 1.]
#   prismatic pinocchio tip at [1.  0.  0.5]
#   prismatic MuJoCo    tip at [1.  0.  0.5]
#   revolute  yourdfpy  tip at [0.8776 0.4794 0.    ]
#   revolute  ikpy      tip at [0.8776 0.9589 0.    ]
#   revolute  pinocchio tip at [0.8776 0.4794 0.    ]
#   revolute  MuJoCo    tip at [0.8776 0.4794 0.    ]
