"""How many poses does my device need to see the ripple of a gear?

Each session is simulated with the noise of the device; the diagnosis does not know what is hidden.
"""

import parallel_cal as pc

robot = pc.new_model("delta24")
for poses in (15, 30, 60):
    session = pc.simulate(robot, poses, effects=["gear_transmission_error"], seed=5)
    data = session.dataset()
    fitted = pc.fit(robot, data, joint_sigma=1.2e-4).model
    found = pc.diagnose(fitted, data, joint_sigma=1.2e-4)
    print(poses, "poses:", found.verdict.word, *found.effects)

# Prints:
# 15 poses: unexplained
# 30 poses: explained gear_transmission_error
# 60 poses: explained gear_transmission_error
