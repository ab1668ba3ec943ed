"""Small closed linkages in the formats of simulators, and their kinematics computed by hand.

The five-bar has its fixed hinges at x = -0.05 and 0.05 m, cranks of 0.1 m and rods of 0.15 m. It is
drawn with the cranks at 120 and 60 degrees. Readings of the MJCF are the angles of the cranks;
those of the others are zero where it is drawn.
"""

import numpy as np
from scipy.spatial.transform import Rotation

LEFT, RIGHT = np.radians([120.0, 60.0]).tolist()
CRANK, ROD, HALF = 0.1, 0.15, 0.05


def five_bar_tip(left, right):
    """Intersect the circles about both elbows: the tip above them."""
    one = np.array([-HALF, 0.0]) + CRANK * np.array([np.cos(left), np.sin(left)])
    other = np.array([HALF, 0.0]) + CRANK * np.array([np.cos(right), np.sin(right)])
    between = other - one
    across = np.array([-between[1], between[0]]) / np.linalg.norm(between)
    height = np.sqrt(ROD**2 - between @ between / 4)
    return (one + other) / 2 + height * across


DRAWN = five_bar_tip(LEFT, RIGHT)
ELBOWS = [
    np.array([foot + CRANK * np.cos(angle), CRANK * np.sin(angle)])
    for foot, angle in ((-HALF, LEFT), (HALF, RIGHT))
]
RODS = [float(np.arctan2(*(DRAWN - elbow)[::-1])) for elbow in ELBOWS]  # their directions
BENDS = [rod - crank for rod, crank in zip(RODS, (LEFT, RIGHT), strict=True)]

FIVE_BAR_MJCF = f"""<?xml version="1.0"?>
<!-- a five-bar -->
<mujoco model="five bar">
  <compiler angle="degree" autolimits="true"/>
  <default>
    <default class="hinge">
      <joint axis="0 0 1"/>
    </default>
  </default>
  <worldbody>
    <body name="frame" pos="1 2 0.5" euler="0 0 30">
      <frame pos="-{HALF} 0 0">
        <body name="left_crank" euler="0 0 120" childclass="hinge">
          <joint name="left" ref="120" range="60 180"/>  <!-- motor 1 -->
          <geom type="capsule" size="0.01" fromto="0 0 0 {CRANK} 0 0"/>
          <body name="left_rod" pos="{CRANK} 0 0" euler="0 0 {float(np.degrees(BENDS[0]))!r}">
            <joint name="left_elbow"/>
            <site name="tip" pos="{ROD} 0 0"/>
          </body>
        </body>
      </frame>
      <body name="right_crank" pos="{HALF} 0 0" axisangle='0 0 1 60'>
        <joint class="hinge" name="right" ref="60" range="0 120"/>
        <body name="right_rod" pos="{CRANK} 0 0"
              quat="{float(np.cos(BENDS[1] / 2))!r} 0 0 {float(np.sin(BENDS[1] / 2))!r}">
          <joint name="right_elbow" axis="0 0 2"/>
          <site name="other_tip" pos="{ROD} 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <connect name="pin" body1="left_rod" body2="right_rod" anchor="{ROD} 0 0"/>
  </equality>
  <actuator>
    <position joint="left" kp="10"/>
    <motor joint="right"/>
  </actuator>
</mujoco>
"""


def five_bar_urdf(closing):
    """Return a URDF; `closing` are elements that close the loop."""
    turn = [f"0 0 {angle!r}" for angle in (LEFT, BENDS[0], RIGHT, BENDS[1])]

    def joint(name, parent, child, xyz, rpy, kind="revolute"):
        return f"""
  <joint name="{name}" type="{kind}">
    <origin rpy="{rpy}" xyz="{xyz}"/>
    <parent link="{parent}"/>
    <child link="{child}"/>
    <axis xyz="0 0 1"/>
    <limit effort="1" velocity="3"/>
  </joint>"""

    links = "frame left_crank left_rod right_crank right_rod tip left_pin right_pin".split()
    return (
        '<robot name="five_bar">\n  <!-- drawn closed -->'
        + "".join(f'\n  <link name="{link}"/>' for link in links)
        + joint("left", "frame", "left_crank", f"-{HALF} 0 0", turn[0])
        + joint("left_elbow", "left_crank", "left_rod", f"{CRANK} 0 0", turn[1])
        + joint("right", "frame", "right_crank", f"{HALF} 0 0", turn[2])
        + joint("right_elbow", "right_crank", "right_rod", f"{CRANK} 0 0", turn[3])
        + joint("tip_fixed", "left_rod", "tip", f"{ROD} 0 0", "0 0 0", "fixed")
        + joint("left_end", "left_rod", "left_pin", f"{ROD} 0 0", "0 0 0", "fixed")
        + joint("right_end", "right_rod", "right_pin", f"{ROD} 0 0", "0 0 0", "fixed")
        + f"\n{closing}</robot>\n"
    )


CONSTRAINT = f"""  <constraint name="pin" type="revolute">
    <parent link="left_rod"/>
    <parent_origin xyz="{ROD} 0 0" rpy="0 0 0"/>
    <parent_axis xyz="0 0 1"/>
    <child link="right_rod"/>
    <child_origin xyz="{ROD} 0 0" rpy="0 0 {RODS[0] - RODS[1]!r}"/>
  </constraint>
"""
LOOP_FILE = "closed_loop: [[left_pin, right_pin]]\ntype: [3d]\nname_mot: [left, right]\n"


SPATIAL_URDF = """<robot name="two_arms">
  <link name="base"/><link name="left_crank"/><link name="knuckle"/><link name="plate"/>
  <link name="right_crank"/><link name="cup"/><link name="tip"/><link name="seat"/>
  <link name="socket"/>
  <joint name="left" type="revolute"><origin xyz="0.1 0 0" rpy="0.2 0 0.3"/>
    <parent link="base"/><child link="left_crank"/><axis xyz="0 0 1"/></joint>
  <joint name="left_elbow" type="revolute"><origin xyz="0 0.3 0.02" rpy="0 0.1 0"/>
    <parent link="left_crank"/><child link="knuckle"/><axis xyz="0 0 1"/></joint>
  <joint name="tilt" type="revolute"><origin xyz="0.03 0 0.01" rpy="0 1.4 0"/>
    <parent link="knuckle"/><child link="plate"/><axis xyz="0 0 1"/></joint>
  <joint name="right" type="revolute"><origin xyz="-0.1 0 0"/>
    <parent link="base"/><child link="right_crank"/><axis xyz="0 0.1 1"/></joint>
  <joint name="right_elbow" type="revolute"><origin xyz="-0.02 0.28 0"/>
    <parent link="right_crank"/><child link="forearm"/><axis xyz="0 0 1"/></joint>
  <joint name="ball" type="revolute"><origin xyz="0.1 0.12 0.02" rpy="0.1 0 0"/>
    <parent link="forearm"/><child link="cup"/><axis xyz="0 0 1"/></joint>
  <joint name="seat_fixed" type="fixed"><origin xyz="0.04 0.01 0.03"/>
    <parent link="cup"/><child link="seat"/></joint>
  <joint name="socket_fixed" type="fixed"><origin xyz="{xyz}" rpy="{rpy}"/>
    <parent link="plate"/><child link="socket"/></joint>
  <joint name="tip_fixed" type="fixed"><origin xyz="0.05 0.1 0.02"/>
    <parent link="plate"/><child link="tip"/></joint>
  <link name="forearm"/>
</robot>
"""
SPATIAL_LOOP = (
    "closed_loop: [[seat, socket]]\ntype: [6d]\nname_mot: [left, right]\n"
    "joint_name: [ball]\njoint_type: [SPHERICAL]\n"
)


def spatial_urdf():
    """Return a URDF of two arms that a pose of two links joins, drawn closed: its ball is where the
    arms meet, so that it closes the loop."""

    def frame(xyz, rpy=(0, 0, 0)):
        placed = np.eye(4)
        placed[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        placed[:3, 3] = xyz
        return placed

    left = frame([0.1, 0, 0], [0.2, 0, 0.3]) @ frame([0, 0.3, 0.02], [0, 0.1, 0])
    plate = left @ frame([0.03, 0, 0.01], [0, 1.4, 0])
    cup = frame([-0.1, 0, 0]) @ frame([-0.02, 0.28, 0]) @ frame([0.1, 0.12, 0.02], [0.1, 0, 0])
    socket = np.linalg.solve(plate, cup @ frame([0.04, 0.01, 0.03]))
    turn = Rotation.from_matrix(socket[:3, :3]).as_euler("xyz")
    words = [" ".join(repr(float(v)) for v in part) for part in (socket[:3, 3], turn)]
    return SPATIAL_URDF.format(xyz=words[0], rpy=words[1])


def five_bar_sdf():
    """Return an SDF whose last joint closes the loop."""
    links = {
        "left_crank": (-HALF, 0.0, LEFT),
        "right_crank": (HALF, 0.0, RIGHT),
        "left_rod": (*ELBOWS[0].tolist(), RODS[0]),
        "right_rod": (*ELBOWS[1].tolist(), RODS[1]),
    }
    joints = {
        "left": ("world", "left_crank", "0 0 0"),
        "left_elbow": ("left_crank", "left_rod", "0 0 0"),
        "right": ("world", "right_crank", "0 0 0"),
        "right_elbow": ("right_crank", "right_rod", "0 0 0"),
        "pin": ("left_rod", "right_rod", f"{ROD} 0 0"),
    }
    text = '<?xml version="1.0"?>\n<sdf version="1.9">\n <model name="five_bar">\n'
    for name, (x, y, angle) in links.items():
        text += f'  <link name="{name}">\n   <pose>{x!r} {y!r} 0 0 0 {angle!r}</pose>\n  </link>\n'
    for name, (parent, child, at) in joints.items():
        text += (
            f'  <joint name="{name}" type="revolute">\n   <pose>{at} 0 0 0</pose>\n'
            f"   <parent>{parent}</parent>\n   <child>{child}</child>\n"
            '   <axis><xyz expressed_in="__model__">0 0 1</xyz></axis>  <!-- upright -->\n'
            "  </joint>\n"
        )
    return text + (
        '  <frame name="tip" attached_to="left_rod">\n'
        f"   <pose>{ROD} 0 0 0 0 0</pose>\n  </frame>\n"
        " </model>\n</sdf>\n"
    )


ANKLE_MJCF = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="shank" pos="0 0 0.4">
      <freejoint/>
      <body name="foot">
        <joint name="pitch" axis="0 1 0"/>
        <joint name="roll" axis="1 0 0"/>
        <site name="toe" pos="0.1 0 -0.03"/>
        <site name="left_heel" pos="-0.05 0.035 0"/>
      </body>
      <body name="left_crank" pos="0 0.035 0.25">
        <joint name="left" axis="0 1 0" range="-1 1"/>
        <body name="left_bar" pos="-0.05 0 0">
          <joint name="left_ball" type="ball"/>
          <site name="left_end" pos="0 0 -0.25"/>
        </body>
      </body>
      <body name="right_crank" pos="0 -0.035 0.2">
        <joint name="right" axis="0 1 0" range="-1 1"/>
        <body name="right_bar" pos="-0.05 0 0">
          <joint name="right_swing" axis="0 1 0"/>
          <joint name="right_tilt" axis="1 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <connect site1="left_end" site2="left_heel"/>
    <connect body1="right_bar" body2="foot" anchor="0 0 -0.2"/>
  </equality>
  <actuator>
    <motor joint="left"/>
    <motor joint="right"/>
  </actuator>
</mujoco>
"""

STRUT_URDF = f"""<robot name="lever">
  <link name="base"/><link name="lever"/><link name="tip"/><link name="eye"/>
  <link name="holder"/><link name="barrel"/><link name="piston"/><link name="pin"/>
  <joint name="hinge" type="revolute"><origin xyz="0 0 0"/>
    <parent link="base"/><child link="lever"/><axis xyz="0 0 1"/></joint>
  <joint name="tip_fixed" type="fixed"><origin xyz="0.05 0.25 0.01"/>
    <parent link="lever"/><child link="tip"/></joint>
  <joint name="eye_fixed" type="fixed"><origin xyz="0 0.2 0"/>
    <parent link="lever"/><child link="eye"/></joint>
  <joint name="holder_hinge" type="revolute"><origin xyz="0.1 0 0" rpy="0.4 0 0"/>
    <parent link="base"/><child link="holder"/><axis xyz="1 0 0"/></joint>
  <joint name="spherical_foot" type="revolute">
    <origin xyz="0.05 0 0" rpy="-0.4 0 {float(np.arctan2(0.2, -0.15))!r}"/>
    <parent link="holder"/><child link="barrel"/><axis xyz="0 0 1"/></joint>
  <joint name="motor" type="prismatic"><origin xyz="0.1 0 0"/>
    <parent link="barrel"/><child link="piston"/><axis xyz="-1 0 0"/></joint>
  <joint name="pin_fixed" type="fixed"><origin xyz="0.15 0 0"/>
    <parent link="piston"/><child link="pin"/></joint>
</robot>
"""
STRUT_LOOP = "closed_loop: [[pin, eye]]\ntype: [3d]\nname_mot: [motor]\n"


def lever_tip(reading):
    """Return the tip of the lever (x, y): its angle follows by the law of cosines from the strut of
    0.25 m - reading, from (0.15, 0) to the eye at 0.2 m."""
    at_hinge = np.arccos((0.2**2 + 0.15**2 - (0.25 - reading) ** 2) / (2 * 0.2 * 0.15))
    c, s = np.cos(at_hinge - np.pi / 2), np.sin(at_hinge - np.pi / 2)
    return np.array([c * 0.05 - s * 0.25, s * 0.05 + c * 0.25])
