"""What if no effect of the catalogue explains the error?

The search finds where the error enters and on what it depends, proves the law at held-out poses,
and writes it as an effect that can be read and edited.
"""

import parallel_cal as pc

model = pc.new_model("delta24")
session = pc.simulate(model, 80, effects=["examples.own_effect:sin=0.002"], seed=3)
data = session.dataset()
fitted = pc.fit(model, data).model

found = pc.discover(fitted, data)
print(found)
for law in found.laws:
    print(law.sentence)

# Prints:
# Discovery(delta24, 80 samples, described: joints by reading)
# The reading of joint1, joint2 and joint3 errs with the reading of its own joint
