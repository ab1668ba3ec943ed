"""A five-bar with the action FollowJointTrajectory and a tracker on /tf: numpy and rclpy only.

    python -m bench.truth.foreign_five_bar [--runs 3] [--busy 2] [--speed 2]    # campaigns
    python -m bench.truth.foreign_five_bar --cell SEED SPEED TRUTH              # the cell

The cell has nothing from parallel_cal. Its cranks, rods and motors are not as drawn, the left drive
has backlash, and the tracker has a frame of its own and stamps its poses late. Each run prints one
line: the effects named, the widths found (mrad), and the rms position error (um) before and after
at joint positions that nobody measured. The exit status is 1 if another effect than backlash is
named.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

JOINTS = ("left", "right")
TRACKER, BODY = "tracker", "gripper"
ACTION = "/five_bar_controller/follow_joint_trajectory"
HOME = np.radians([120.0, 60.0])
PLAY = np.array([2e-3, 0.0])  # rad of backlash
READING, SIGHT, ANGLE = 5e-6, 5e-6, 20e-6  # noise: rad, m, rad
STEP, POSE_STEPS, STAMPED_LATE = 0.01, 5, 0.04  # s, steps between poses, s
N_TRUE_POSES = 200
START_S = 8.0  # s after which the cell and the node are asked


def make_robot(seed):
    """The robot as it was built: base, crank, rod (m) and zero (rad) of both sides."""
    rng = np.random.default_rng(seed)
    drawn = np.array([[-0.05, 0.0, 0.1, 0.15, 0.0], [0.05, 0.0, 0.1, 0.15, 0.0]])
    return drawn + rng.normal(size=(2, 5)) * [2e-4, 2e-4, 2e-4, 2e-4, 5e-3]


def position(robot, angles):
    """The point (n, 2) where the rods meet, for the motors' angles (n, 2)."""
    x, y, crank, rod, zero = robot.T
    turned = angles + zero
    elbow = np.stack([x + crank * np.cos(turned), y + crank * np.sin(turned)], axis=-1)
    left, way = elbow[:, 0], elbow[:, 1] - elbow[:, 0]
    far = np.linalg.norm(way, axis=1)
    along = (far**2 + rod[0] ** 2 - rod[1] ** 2) / (2 * far)
    up = np.sqrt(rod[0] ** 2 - along**2)
    unit = way / far[:, None]
    return left + along[:, None] * unit + up[:, None] * np.stack([-unit[:, 1], unit[:, 0]], axis=1)


def turned(w):
    """The quaternion (x, y, z, w) of a rotation vector."""
    angle = max(float(np.linalg.norm(w)), 1e-12)
    return np.append(np.sin(angle / 2) / angle * np.asarray(w), np.cos(angle / 2))


def matrix(quaternion):
    x, y, z, w = quaternion
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * K + 2 * K @ K


def product(one, other):
    """The quaternion of one turn after the other."""
    v, w = one[:3], one[3]
    vector = w * other[:3] + other[3] * v + np.cross(v, other[:3])
    return np.append(vector, w * other[3] - v @ other[:3])


def run_cell(seed, speed, truth):
    """Control the robot and look at it until the process ends."""
    import rclpy
    from control_msgs.action import FollowJointTrajectory
    from geometry_msgs.msg import TransformStamped
    from rclpy.action import ActionServer, CancelResponse
    from rclpy.callback_groups import ReentrantCallbackGroup
    from rclpy.executors import MultiThreadedExecutor
    from sensor_msgs.msg import JointState
    from tf2_msgs.msg import TFMessage

    rclpy.init()
    node, rng = rclpy.create_node("five_bar"), np.random.default_rng(seed + 1000)
    robot, shift, turn = make_robot(seed), rng.uniform(-1, 1, 3), turned(rng.uniform(-0.6, 0.6, 3))
    Path(truth).write_text(json.dumps(robot.tolist()))
    states = node.create_publisher(JointState, "joint_states", 1000)
    frames = node.create_publisher(TFMessage, "/tf", 1000)
    lock, motion = threading.Lock(), {"goal": None, "path": None}
    q, rate, links, now = HOME.copy(), np.zeros(2), HOME.copy(), 0.0
    begin = time.time()

    def execute(handle):
        trajectory = handle.request.trajectory
        order = [list(trajectory.joint_names).index(joint) for joint in JOINTS]
        with lock:
            ends = [p.time_from_start for p in trajectory.points]
            at = np.array([now, *(now + t.sec + 1e-9 * t.nanosec for t in ends)])
            to = np.array([q, *(np.array(p.positions)[order] for p in trajectory.points)])
            motion["goal"], motion["path"] = handle, (at, to)
        while motion["goal"] is handle and now < at[-1] + 0.05 and not handle.is_cancel_requested:
            feedback = FollowJointTrajectory.Feedback(joint_names=list(JOINTS))
            feedback.actual.positions = q.tolist()
            handle.publish_feedback(feedback)
            time.sleep(0.05)
        result = FollowJointTrajectory.Result()
        if motion["goal"] is not handle:
            handle.abort()
        elif handle.is_cancel_requested:
            with lock:
                motion["path"] = None
            handle.canceled()
        else:
            handle.succeed()
        return result

    ActionServer(
        node, FollowJointTrajectory, ACTION, execute, callback_group=ReentrantCallbackGroup(),
        cancel_callback=lambda goal: CancelResponse.ACCEPT,
    )  # fmt: skip

    def stamped(message, seconds):
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            round(1e9 * (begin + seconds)), 10**9
        )
        return message

    def look():
        x, y = position(robot, links[None])[0]
        r = shift + matrix(turn) @ [x, y, 0.0] + SIGHT * rng.standard_normal(3)
        seen = TransformStamped(child_frame_id=BODY)
        seen.header.frame_id = TRACKER
        d, o = seen.transform.translation, seen.transform.rotation
        d.x, d.y, d.z = map(float, r)
        o.x, o.y, o.z, o.w = map(float, product(turned(ANGLE * rng.standard_normal(3)), turn))
        frames.publish(TFMessage(transforms=[stamped(seen, now + STAMPED_LATE)]))

    executor = MultiThreadedExecutor(4)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    last, count = time.monotonic(), 0
    while rclpy.ok():
        time.sleep(STEP / speed / 2)
        if speed * (time.monotonic() - last) < STEP:
            continue
        last = time.monotonic()  # one step however long it took: a slow computer slows the cell
        with lock:
            now, before, count = now + STEP, q.copy(), count + 1
            if motion["path"] is not None:
                at, to = motion["path"]
                q = np.array([np.interp(now, at, column) for column in to.T])
            rate = (q - before) / STEP
            links = np.clip(links, q - PLAY / 2, q + PLAY / 2)
        message = stamped(JointState(name=list(JOINTS), velocity=rate.tolist()), now)
        message.position = (q + READING * rng.standard_normal(2)).tolist()
        states.publish(message)
        if count % POSE_STEPS == 0:
            look()


def true_error(model, robot):
    """Rms position error (m) at joint positions that nobody measured, after the best rigid motion
    in the plane: a tracker in a frame of its own does not determine the base's frame."""
    from scipy.optimize import least_squares

    from parallel_cal.kinematics.kinematics import Kinematics

    rng = np.random.default_rng(7)
    joints = HOME + rng.uniform(-0.3, 0.3, (N_TRUE_POSES, 2))
    direction = rng.choice([-1.0, 1.0], joints.shape)
    true = position(robot, joints - direction * PLAY / 2)
    at = {f"direction.{joint}": direction[:, i] for i, joint in enumerate(JOINTS)}
    found = Kinematics(model.robot()).direct(joints, at).position[:, :2]

    def errors(x):
        c, s = np.cos(x[2]), np.sin(x[2])
        return (found @ np.array([[c, s], [-s, c]]) + x[:2] - true).ravel()

    best = least_squares(errors, np.zeros(3), x_scale=1e-3)
    return float(np.sqrt(np.mean(np.sum(best.fun.reshape(-1, 2) ** 2, axis=1))))


def run_campaign(folder, seed, speed, minutes):
    """Run a campaign at the cell as its owner would, and compare the result with the truth."""
    from dataclasses import replace

    from parallel_cal.model.file.modelfile import read_model, write_model
    from parallel_cal.model.model import Noise, new_model

    drawn = replace(new_model("five_bar"), noise=Noise(READING, SIGHT, ANGLE))
    drawn.mechanism.joint_rates = ((1.0, 5.0),) * 2  # rad/s and rad/s^2
    file, truth = folder / "robot.yaml", folder / "truth.json"
    write_model(drawn, file)
    node = "import sys; from parallel_cal.nodes.calibration_node import main; sys.exit(main())"
    values = {
        "model_file": file,
        "journal_folder": folder / "journal",
        "trajectory_action": ACTION,
        "driver_type": "tf2_msgs/msg/TFMessage",
        "body": BODY,
    }
    arguments = [a for name, value in values.items() for a in ("-p", f"{name}:={value}")]
    commands = {
        "cell": [__file__, "--cell", str(seed), str(speed), str(truth)],
        "node": ["-c", node, "--ros-args", "-r", "measured_pose:=/tf", *arguments],
    }
    running = []
    for name, command in commands.items():
        with (folder / f"{name}.log").open("w") as log:
            running.append(subprocess.Popen([sys.executable, *command], stdout=log, stderr=log))
    command = "from parallel_cal.cli.main import main; main()"
    asked = ["calibrate", str(file), "--minutes", str(minutes)]
    try:
        time.sleep(START_S)
        done = subprocess.run(
            [sys.executable, "-c", command, *asked], capture_output=True, text=True
        )
    finally:
        for process in reversed(running):
            process.send_signal(signal.SIGINT)
        for process in running:
            process.wait(30)
    robot, found = np.array(json.loads(truth.read_text())), read_model(file)
    effects = [effect.name for effect in found.effects]
    widths = [1e3 * found.value(f"backlash.{j}.width") for j in JOINTS if "backlash" in effects]
    before, after = (1e6 * true_error(model, robot) for model in (drawn, found))
    (folder / "calibrate.log").write_text(done.stdout + done.stderr)
    print(
        f"seed {seed}, load {os.getloadavg()[0]:.1f}: {effects}, widths "
        f"{np.round(widths, 4).tolist()} mrad, error {before:.1f} -> {after:.2f} um; "
        f"{done.stdout.strip().splitlines()[-2:]}",
        flush=True,
    )
    return set(effects) <= {"backlash"}


def main():
    if sys.argv[1:2] == ["--cell"]:
        run_cell(int(sys.argv[2]), float(sys.argv[3]), sys.argv[4])
        return 0
    arguments = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    arguments.add_argument("--runs", type=int, default=1)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--busy", type=int, default=0, help="loops that use the processor")
    arguments.add_argument("--speed", type=float, default=2.0, help="of the cell's clock")
    arguments.add_argument("--minutes", type=float, default=15.0)
    given, wrong = arguments.parse_args(), 0
    for seed in range(given.seed, given.seed + given.runs):
        loop = [sys.executable, "-c", "while True: pass"]
        loops = [subprocess.Popen(loop) for _ in range(given.busy)]
        try:
            with tempfile.TemporaryDirectory() as folder:
                wrong += not run_campaign(Path(folder), seed, given.speed, given.minutes)
        finally:
            for process in loops:
                process.kill()
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
