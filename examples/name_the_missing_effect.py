"""Which physical effect does my model lack, and does the robot become better with it?

`add` refuses an effect that does not lower the error at held-out poses.
"""

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
data = pc.load_dataset("bags/delta_backlash", joints=model.joints)

fitted = pc.fit(model, data).model
found = pc.diagnose(fitted, data)
print(found.verdict.word, *found.effects)

step = pc.add(fitted, found.effects[0], data)
print(step.model)
print(f"width of joint1: {1e3 * step.model.value('backlash.joint1.width'):.3f} mrad")

# Prints:
# explained backlash
# Model(delta54 + backlash, 57 parameters)
# width of joint1: 0.239 mrad
