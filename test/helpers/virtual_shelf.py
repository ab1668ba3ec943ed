"""Robots of the shelf from points, axes and passive joints: servo Stewart, hexaglide, ankle,
four-armed Delta, 3-PRS, 3-RRS, palletizer, and the struts of tripods and pentapods.

Unlike the closures, these robots keep their passive joints: a hinged rod has a swing, a linkage has
the angle of every lever, a universal joint its two angles. They use no room but `virtual/`.
"""

import numpy as np

from parallel_cal.virtual.robot import apply, axis_rotation, stack, turn
from parallel_cal.virtual.stewart import Assembly, column, numbered, vectors

CHAINS, LEGS = numbered("chain", 3), numbered("leg", 6)
TRIPOD_LEGS = numbered("leg", 3)
THIRDS = np.arange(3) * 2 * np.pi / 3


def direction(*angles):
    """Unit vectors (..., 3) at an angle about z, then at an elevation."""
    about, up = np.broadcast_arrays(*angles)
    return stack([np.cos(about) * np.cos(up), np.sin(about) * np.cos(up), np.sin(up)])


def of(parameters, part, names):
    """A point (3,) of one part; an empty name is a coordinate that is zero."""
    return stack(parameters[f"{part}.{name}"] if name else 0.0 for name in names)


def rotation_gap(built, R):
    """Rotation vector (..., 3) between two nearly equal rotations, to first order."""
    E = np.swapaxes(built, -1, -2) @ R
    return stack([E[..., 2, 1], E[..., 0, 2], E[..., 1, 0]]) / 2 - (
        stack([E[..., 1, 2], E[..., 2, 0], E[..., 0, 1]]) / 2
    )


class Servo:
    """Cranks on servo axes: one end of every rod."""

    def __init__(self, parameters, legs):
        self.hub = vectors(parameters, ["D_x", "D_y", "D_z"], legs)
        heading = column(parameters, "theta", legs)
        self.level = direction(heading, 0 * heading)
        across = direction(heading + np.pi / 2, 0 * heading)
        tilt = column(parameters, "alpha", legs)
        self.axis = apply(turn(self.level * tilt[:, None]), across)
        self.zero, self.crank = (column(parameters, name, legs) for name in ("q0", "crank"))

    def balls(self, q):
        """The cranks' balls (..., legs, 3): they turn about the axes towards +z."""
        swing = turn(-self.axis * (q + self.zero)[..., None])
        return self.hub + apply(swing, self.level * self.crank[..., None])


class StewartRss(Assembly):
    """Six servo cranks, six rods, one platform."""

    home = (0.0, 0.0, 0.14)
    home_joints = (0.0,) * 6

    def __init__(self, parameters):
        super().__init__(parameters)
        self.servo = Servo(parameters, LEGS)
        self.platform = vectors(parameters, ["B_x", "B_y", "B_z"], LEGS)
        self.rod = column(parameters, "rod", LEGS)

    def gaps(self, q, r, R, hidden):
        top = r[..., None, :] + apply(R[..., None, :, :], self.platform)
        return np.linalg.norm(top - self.servo.balls(q), axis=-1) - self.rod


class Hexaglide(Assembly):
    """Six carriages on rails along x, six rods, one platform."""

    home = (0.0, 0.0, 0.25)
    home_joints = (0.0,) * 6

    def __init__(self, parameters):
        super().__init__(parameters)
        self.base = vectors(parameters, ["C_x", "C_y", "C_z"], LEGS)
        self.platform = vectors(parameters, ["B_x", "B_y", "B_z"], LEGS)
        self.rod = column(parameters, "rod", LEGS)
        # alpha turns the rail towards -y, beta then towards -z.
        sideways, down = (column(parameters, name, LEGS) for name in ("alpha", "beta"))
        self.rail = direction(-sideways, -down)

    def gaps(self, q, r, R, hidden):
        carriage = self.base + self.rail * q[..., None]
        top = r[..., None, :] + apply(R[..., None, :, :], self.platform)
        return np.linalg.norm(top - carriage, axis=-1) - self.rod


class Ankle2Rsu(Assembly):
    """A foot on two hinges, the angles of which are hidden, and two servo cranks with rods."""

    controls = "rx ry"
    home = (0.0, 0.0, -0.05)
    home_joints = (0.0, 0.0)

    def __init__(self, parameters, first="pitch"):
        super().__init__(parameters)
        sides = ["left", "right"]
        self.servo = Servo(parameters, sides)
        self.foot = vectors(parameters, ["B_x", "B_y", "B_z"], sides)
        self.rod = column(parameters, "rod", sides)
        p = {name.removeprefix("ankle."): value for name, value in parameters.items()}
        if first == "pitch":  # y turned about x, then z; x turned about y, then z
            self.a = turn([0, 0, p["a_z"]]) @ turn([p["a_x"], 0, 0]) @ [0, 1, 0]
            self.b = turn([0, 0, p["b_z"]]) @ turn([0, p["b_y"], 0]) @ [1, 0, 0]
        else:
            self.a = turn([0, 0, p["a_z"]]) @ turn([0, p["a_y"], 0]) @ [1, 0, 0]
            self.b = turn([0, 0, p["b_z"]]) @ turn([p["b_x"], 0, 0]) @ [0, 1, 0]
        self.across = np.cross(self.a, [0, 0, 1])  # where the second axis points at zero
        self.across = -self.across if first == "roll" else self.across
        self.across /= np.linalg.norm(self.across)
        second = np.cos(p["angle"]) * self.a + np.sin(p["angle"]) * self.across
        self.normal = np.cross(self.a, self.across)
        aside = np.cross(self.b, [0, 0, 1])
        aside /= np.linalg.norm(aside)
        frame = np.column_stack([second, self.normal, np.cross(second, self.normal)])
        own = np.column_stack([self.b, aside, np.cross(self.b, aside)])
        self.zero = frame @ own.T
        self.c, self.f = (
            of(parameters, "ankle", ["c_x", "c_y", "c_z"]),
            of(parameters, "ankle", ["f_x", "f_y", "f_z"]),
        )
        self.offset = p["offset"]

    def build(self, hidden):
        """The foot's pose by the angles of both hinges."""
        first, second = (
            turn(axis * hidden[..., i, None]) for i, axis in enumerate((self.a, self.b))
        )
        R = first @ self.zero @ second
        return self.c + self.offset * apply(first, self.normal) - apply(R, self.f), R

    def hidden(self, q, r, R):
        b = apply(R, np.broadcast_to(self.b, r.shape))
        one = np.arctan2(b @ self.normal, b @ self.across)
        rest = np.swapaxes(turn(self.a * one[..., None]) @ self.zero, -1, -2) @ R
        sine = rotation_gap(np.broadcast_to(np.eye(3), rest.shape), rest) @ self.b
        two = np.arctan2(sine, (np.trace(rest, axis1=-2, axis2=-1) - 1) / 2)
        return stack([one, two])

    def gaps(self, q, r, R, hidden):
        at, turned = self.build(hidden)
        top = r[..., None, :] + apply(R[..., None, :, :], self.foot)
        rods = np.linalg.norm(top - self.servo.balls(q), axis=-1) - self.rod
        return np.concatenate([rods, at - r, rotation_gap(turned, R)], -1)


class Quattro(Assembly):
    """Four arms with eight rods; two halves of a platform on a bar that turns.

    Hidden are the rotation of the first half, and that of the second half about the hinge. Exact
    parallelograms keep both at zero: nothing here says so but the rods.
    """

    moves = controls = "x y z rz"
    home = (0.0, 0.0, -0.7410704155249)
    home_joints = (np.radians(-20),) * 4
    chains = numbered("chain", 4)

    def __init__(self, parameters, half_width=0.3):
        super().__init__(parameters)
        z, x = (column(parameters, name, self.chains) for name in ("theta", "alpha"))
        frame = axis_rotation("z", z) @ axis_rotation("x", x)
        self.motor = frame[..., 2]
        self.bar = self.motor * half_width
        # From the hinge of its half to the middle of a chain's two balls: any vector will do.
        self.ball = 0.05 * direction(z, 0 * z + 0.3)
        self.hub = self.ball + apply(frame, vectors(parameters, ["D_x", "D_y", "D_z"], self.chains))
        self.arm = apply(frame, vectors(parameters, ["La_x", "La_y", ""], self.chains))
        self.rod = column(parameters, "Lb", self.chains)
        self.hinge = [of(parameters, "platform", [f"{h}_x", f"{h}_y", ""]) for h in "ab"]
        self.gear = parameters["platform.gear"]

    def hidden(self, q, r, R):
        return np.zeros((*np.shape(r)[:-1], 4))

    def gaps(self, q, r, R, hidden):
        bar = axis_rotation("z", np.arctan2(R[..., 1, 0], R[..., 0, 0]) / self.gear)
        one = turn(hidden[..., :3])
        halves = [one, one @ axis_rotation("z", hidden[..., 3])]
        elbow = self.hub + apply(turn(self.motor * q[..., None]), self.arm)
        gaps = []
        for i in range(4):
            half = halves[i // 2]
            hinge = r + apply(one @ bar, np.broadcast_to(self.hinge[i // 2], r.shape))
            for side in (1, -1):
                ball = self.ball[i] + side * self.bar[i]
                end = hinge + apply(half, np.broadcast_to(ball, r.shape))
                span = end - elbow[..., i, :] - side * self.bar[i]
                gaps.append(np.linalg.norm(span, axis=-1) - self.rod[i])
        return stack(gaps)


class SwingLegs(Assembly):
    """Three rods that swing about hinges; the swings are hidden."""

    controls = "z rx ry"

    def __init__(self, parameters):
        super().__init__(parameters)
        self.frame = axis_rotation("z", THIRDS)
        self.ball = apply(self.frame, vectors(parameters, ["B_x", "B_y", "B_z"], CHAINS))
        self.rod = column(parameters, "rod", CHAINS)
        turned, tilted = (column(parameters, name, CHAINS) for name in ("gamma", "delta"))
        self.hinge_axis = direction(turned + np.pi / 2, tilted)  # in the chain's frame

    def hinges(self, q):
        """Points and axes (..., 3 chains, 3) of the hinges."""
        raise NotImplementedError

    def swung(self, q, hidden):
        """The rods' balls at some swings from the direction across axis and z."""
        E, n = self.hinges(q)
        out = np.cross(n, [0, 0, 1])
        out /= np.linalg.norm(out, axis=-1, keepdims=True)
        return E + apply(turn(n * hidden[..., None]), out * self.rod[:, None])

    def hidden(self, q, r, R):
        E, n = self.hinges(q)
        out = np.cross(n, [0, 0, 1])
        span = r[..., None, :] + apply(R[..., None, :, :], self.ball) - E
        return np.arctan2(np.sum(span * np.cross(n, out), -1), np.sum(span * out, -1))

    def gaps(self, q, r, R, hidden):
        top = r[..., None, :] + apply(R[..., None, :, :], self.ball)
        apart = top - self.swung(q, hidden)
        return apart.reshape(*apart.shape[:-2], 9)


class TripodPrs(SwingLegs):
    """The hinges sit on carriages."""

    home = (0.0, 0.0, 0.1)

    def __init__(self, parameters, inclination=0.0):
        super().__init__(parameters)
        self.start = apply(self.frame, vectors(parameters, ["D_x", "D_y", "D_z"], CHAINS))
        lean = axis_rotation("y", np.full(3, inclination))
        small = [
            axis_rotation(a, column(parameters, n, CHAINS))
            for a, n in zip("xy", ("alpha", "beta"), strict=True)
        ]
        self.rail = (self.frame @ lean @ small[0] @ small[1])[..., 2]
        self.axis = apply(self.frame, self.hinge_axis)
        away = np.array([0.05, -0.1])
        along = away @ [np.sin(inclination), np.cos(inclination)]
        self.home_joints = (-along + np.sqrt(along**2 - away @ away + 0.2**2),) * 3

    def hinges(self, q):
        E = self.start + self.rail * q[..., None]
        return E, np.broadcast_to(self.axis, E.shape)


class PlateRrs(SwingLegs):
    """The hinges sit on cranks and turn with them."""

    home = (0.0, 0.0, 0.1136683088887)
    home_joints = (np.radians(20),) * 3

    def __init__(self, parameters):
        super().__init__(parameters)
        self.hub = apply(self.frame, vectors(parameters, ["D_x", "D_y", "D_z"], CHAINS))
        about, tilt = (column(parameters, name, CHAINS) for name in ("theta", "alpha"))
        self.motor = apply(self.frame, direction(about + np.pi / 2, tilt))
        heading = apply(self.frame, direction(about, 0 * about))
        self.crank = heading * column(parameters, "crank", CHAINS)[:, None]
        rest = self.frame @ axis_rotation("z", about) @ axis_rotation("x", tilt)
        self.axis, self.zero = apply(rest, self.hinge_axis), column(parameters, "q0", CHAINS)

    def hinges(self, q):
        swing = turn(-self.motor * (q + self.zero)[..., None])
        return self.hub + apply(swing, self.crank), apply(swing, self.axis)


class Palletizer(Assembly):
    """Two arms, a crank, a push rod, and two level rods with a lever at the elbow.

    Hidden are the angles of the forearm, of the elbow's lever and of the wrist in the plane of the
    arm, counted from x towards z.
    """

    home = (0.7279879903431, 0.0, 0.5621534171927)
    home_joints = (0.0, np.radians(80), np.radians(-20), 0.0)

    def __init__(self, parameters, flange=True):
        super().__init__(parameters)
        self.flange = flange
        self.controls = "x y z rz" if flange else "x y z"
        self.home_joints = self.home_joints if flange else self.home_joints[:3]
        p = self.parameters
        self.base = turn([p["base.alpha"], 0, 0]) @ turn([0, p["base.beta"], 0])
        self.tip = turn([p["flange.alpha"], 0, 0]) @ turn([0, p["flange.beta"], 0])
        self.foot = stack([p["base.x"], p["base.y"], 0.0])

    def plane(self, q):
        """Shoulder (..., 3), and the plane's rotation."""
        waist = self.base @ axis_rotation("z", q[..., 0] + self.parameters["waist.q0"])
        at = self.foot + apply(
            waist, np.broadcast_to(of(self.parameters, "shoulder", "xyz"), (*q.shape[:-1], 3))
        )
        return at, waist @ turn([self.parameters["shoulder.tilt"], 0, 0])

    def parts(self, q, hidden):
        """Points of the linkage as complex numbers: x + 1j z in the plane, from the shoulder."""
        p, (fore, lever, wrist) = self.parameters, np.moveaxis(hidden, -1, 0)
        elbow = p["upper.length"] * np.exp(1j * (q[..., 1] + p["upper.q0"]))
        crank = p["crank.length"] * np.exp(1j * (q[..., 2] + p["crank.q0"] + np.pi))
        along = np.exp(1j * fore)
        at = {"W": elbow + p["forearm.length"] * along, "G": crank}
        at["F"] = elbow - p["forearm.lever"] * along * np.exp(1j * p["forearm.bend"])
        at["H"] = p["level.base_x"] + 1j * p["level.base_z"]
        at["U"] = elbow + p["level.arm"] * np.exp(1j * lever)
        at["T"] = elbow + (p["level.elbow_x"] + 1j * p["level.elbow_z"]) * np.exp(1j * lever)
        at["V"] = at["W"] + (p["level.wrist_x"] + 1j * p["level.wrist_z"]) * np.exp(1j * wrist)
        return at

    def hidden(self, q, r, R):
        shoulder, M = self.plane(q)
        p, inverse = self.parameters, np.swapaxes(M, -1, -2)
        angle = q[..., 3] if self.flange else 0 * q[..., 0]
        plate = R @ axis_rotation("z", -angle - p["flange.q0"]) @ self.tip.T
        at = r - apply(R, np.broadcast_to(of(p, "tool", "xyz"), r.shape)) - shoulder
        at = apply(inverse, at - p.get("flange.x", 0.0) * plate[..., 0])
        elbow = p["upper.length"] * np.exp(1j * (q[..., 1] + p["upper.q0"]))
        out = apply(inverse, plate[..., 0])
        fore = np.angle(at[..., 0] + 1j * at[..., 2] - elbow)
        return stack([fore, np.pi + 0 * fore, np.arctan2(out[..., 2], out[..., 0])])

    def gaps(self, q, r, R, hidden):
        p, (shoulder, M), at = self.parameters, self.plane(q), self.parts(q, hidden)
        wrist = M @ axis_rotation("y", -hidden[..., 2])
        angle = q[..., 3] if self.flange else 0 * q[..., 0]
        built = wrist @ self.tip @ axis_rotation("z", angle + p["flange.q0"])
        end = shoulder + apply(M, stack([at["W"].real, 0 * at["W"].real, at["W"].imag]))
        end = end + p.get("flange.x", 0.0) * wrist[..., 0]
        end = end + apply(built, np.broadcast_to(of(p, "tool", "xyz"), end.shape))
        rods = [
            np.abs(at["F"] - at["G"]) - p["push.length"],
            np.abs(at["U"] - at["H"]) - p["level.rod1"],
            np.abs(at["V"] - at["T"]) - p["level.rod2"],
        ]
        return np.concatenate([end - r, rotation_gap(built, R), stack(rods)], -1)


class TripodStruts(Assembly):
    """Three struts to one point, as in a surveyor's tripod."""

    moves = controls = "x y z"
    home = (0.2, 0.12, 0.4)
    home_joints = (0.0,) * 3

    def __init__(self, parameters):
        super().__init__(parameters)
        self.feet = vectors(parameters, ["C_x", "C_y", "C_z"], TRIPOD_LEGS)
        self.zero = column(parameters, "L0", TRIPOD_LEGS)

    def gaps(self, q, r, R, hidden):
        """How far a strut that points to the tool ends before it."""
        away = r[..., None, :] - self.feet
        ends = self.feet + away * ((q + self.zero) / np.linalg.norm(away, axis=-1))[..., None]
        return np.sum((r[..., None, :] - ends) * away, axis=-1) / np.linalg.norm(away, axis=-1)


class Pentapod(Assembly):
    """Five struts to rings on a spindle; the angle of each ring is a passive joint.

    A ring turns until its strut lies in the plane of the spindle's axis: its tangent is square to
    the strut.
    """

    controls = "x y z rx ry"
    home = (0.0, 0.0, 0.0)
    home_joints = (0.0,) * 5

    def __init__(self, parameters):
        super().__init__(parameters)
        legs = numbered("leg", 5)
        self.feet = vectors(parameters, ["C_x", "C_y", "C_z"], legs)
        self.zero, self.radius, self.height = (
            column(parameters, name, legs) for name in ("L0", "B_r", "B_z")
        )

    def gaps(self, q, r, R, hidden):
        out = direction(hidden, 0 * hidden)
        across = direction(hidden + np.pi / 2, 0 * hidden)
        ring = self.radius[:, None] * out + self.height[:, None] * np.array([0.0, 0.0, 1.0])
        strut = self.feet - r[..., None, :] - apply(R[..., None, :, :], ring)
        short = np.linalg.norm(strut, axis=-1) - q - self.zero
        aside = np.sum(strut * apply(R[..., None, :, :], across), axis=-1)
        return np.concatenate([short, aside, R[..., 1, :1]], axis=-1)

    def hidden(self, q, r, R):
        """The rings' angles: towards the feet, as seen from the spindle."""
        seen = apply(np.swapaxes(R, -1, -2)[..., None, :, :], self.feet - r[..., None, :])
        return np.arctan2(seen[..., 1], seen[..., 0])


class HangingSled(Assembly):
    """A sled on two taut strings over wheels, at rest where its centre of gravity is lowest.

    No force is computed: along the motion that leaves both strings as long as they are, the height
    of the centre of gravity is stationary. A string over a wheel is its tangent and an arc.
    """

    moves = "x y rz"
    controls = "x y"
    home = (0.0, 0.0, 0.0)
    home_joints = (0.0, 0.0)

    def __init__(self, parameters, wheels="frame", over=True, home=(0.0, 0.0)):
        super().__init__(parameters)
        self.wheels, self.over, self.home = wheels, over, (*home, 0.0)
        p = parameters
        self.anchors, self.mounts = (
            [complex(p[f"{side}.{name}_x"], p[f"{side}.{name}_y"]) for side in ("left", "right")]
            for name in "AB"
        )
        self.weight = complex(p["sled.G_x"], p["sled.G_y"])

    def lengths(self, place, angle):
        """Both strings (..., 2) for the tool at a complex place and the sled turned by an angle."""
        found = []
        for k, (anchor, mount) in enumerate(zip(self.anchors, self.mounts, strict=True)):
            end = place + mount * np.exp(1j * angle)
            on_frame = self.wheels == "frame"
            centre, point = (anchor, end) if on_frame else (end, anchor)
            away, radius = point - centre, self.parameters["wheels.radius"]
            # The tangents touch the wheel on the circle over the centre and the point as diameter.
            spread = np.arccos(radius / np.abs(away))
            clockwise = (-1 if k else 1) * (1 if on_frame else -1)
            touch = np.angle(away) + (1 if self.over else -1) * clockwise * spread
            span = np.abs(point - centre - radius * np.exp(1j * touch))
            # Round the wheel from 12 o'clock, or to 6 o'clock of the sled.
            if on_frame:
                turned = np.pi / 2 - touch if k == 0 else touch - np.pi / 2
                turned = turned if self.over else -turned
            else:
                seen = touch - angle
                turned = seen + np.pi / 2 if k == 0 else 3 * np.pi / 2 - seen
                turned = turned if self.over else -turned
            turned = np.mod(turned + 0.5, 2 * np.pi) - 0.5
            across = self.parameters["sled.standoff"]
            found.append(np.hypot(span, across) + radius * turned)
        return np.stack(found, axis=-1)

    def gaps(self, q, r, R, hidden):
        place, angle = r[..., 0] + 1j * r[..., 1], np.arctan2(R[..., 1, 0], R[..., 0, 0])
        zero = np.array([self.parameters[f"{side}.L0"] for side in ("left", "right")])
        step, slopes = 0.006, []
        for along in np.eye(3):

            def change(size, along=along):
                move = size * step * along
                at = place + move[0] + 1j * move[1], angle + move[2]
                height = (at[0] + self.weight * np.exp(1j * at[1])).imag
                return np.concatenate([self.lengths(*at), height[..., None]], axis=-1)

            weights = (4 / 5, -1 / 5, 4 / 105, -1 / 280)  # to the eighth order
            steps = enumerate(weights, start=1)
            slopes.append(sum(w * (change(k) - change(-k)) for k, w in steps) / step)
        slopes = np.stack(slopes, axis=-1)
        free = np.cross(slopes[..., 0, :], slopes[..., 1, :])
        free /= free[..., 2:]  # m per rad of tilt
        lower = np.sum(slopes[..., 2, :] * free, axis=-1, keepdims=True)
        return np.concatenate([self.lengths(place, angle) - q - zero, lower], axis=-1)
