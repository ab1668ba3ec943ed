"""Which poses should I measure, and how accurate will the robot be afterwards?"""

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
for count in (20, 40, 80):
    plan = pc.plan(model, count)
    expected, random = (1e6 * one.position_rms for one in (plan.expected, plan.random))
    print(f"{count} poses: {expected:.1f} um, chosen at random {random:.1f} um")

# Prints:
# 20 poses: 14.2 um, chosen at random 28.5 um
# 40 poses: 10.1 um, chosen at random 15.3 um
# 80 poses: 7.3 um, chosen at random 10.5 um
