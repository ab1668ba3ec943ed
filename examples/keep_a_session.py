"""How do I keep every step in a folder, and take one back?

The page `parallel-cal workbench` and the command `parallel-cal session` open the same folder.
"""

import parallel_cal as pc

model = pc.read_model("config/delta_mockup_nominal.yaml")
session = pc.Session.new("calibration", model, ["bags/delta_backlash"])
session.fit()
session.add("backlash")
print(session.model)
session.undo()
print(session.model)
session.redo()
print(session.model)

# Prints:
# Model(delta54 + backlash, 57 parameters)
# Model(delta54, 54 parameters)
# Model(delta54 + backlash, 57 parameters)
